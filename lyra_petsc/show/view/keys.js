// Keys of the page; and pictures: vtk.js fetches them from a data: address, which the page may not.
(() => {
  const fetched = window.fetch;
  window.fetch = (what, ...rest) => {
    if (typeof what !== "string" || !what.startsWith("data:")) return fetched(what, ...rest);
    const [head, body] = what.split(",");
    const bytes = Uint8Array.from(atob(body), (sign) => sign.charCodeAt(0));
    return Promise.resolve(new Response(bytes, { headers: { "Content-Type": head.slice(5).split(";")[0] } }));
  };
  const buttons = { " ": "play", ArrowLeft: "back", ArrowRight: "next", Home: "first", End: "last", f: "fit" };
  document.addEventListener("keydown", (event) => {
    const typing = event.target.closest && event.target.closest("input, textarea, .v-select, .v-slider, .v-overlay");
    const button = document.getElementById(buttons[event.key]);
    if (typing || !button || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    button.click();
  });
  // a button that has the focus would be pressed by the space bar as well
  document.addEventListener("keyup", (event) => {
    if (event.key === " " && event.target.closest && event.target.closest("button")) event.preventDefault();
  });
})();
