"""Reports of several results: self-contained HTML, Markdown, figures as PNG and SVG."""
