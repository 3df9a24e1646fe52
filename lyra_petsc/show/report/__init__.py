"""Reports on runs and experiments: self-contained HTML, Markdown, and figures as PNG and SVG."""
