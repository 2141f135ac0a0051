// Reports the pointer over the ping's picture, and the keys that are held, to the server of the page; lays lines of range
// and azimuth over the picture; and cures what viser's page leaves to be wished for.
//
// viser's images have no pointer events, and its keys always fly the camera. This script writes a state as JSON into a
// text field of the page, which viser sends as if it had been typed. The state is complete each time, since of several
// changes within 50 ms viser sends the last alone. `sonar_gl.live.view.browser_state` reads it.
(() => {
  const FIELD = "page state"; // label of the text field
  const KEYS = {
    KeyW: "w", KeyA: "a", KeyS: "s", KeyD: "d", KeyQ: "q", KeyE: "e",
    ArrowUp: "arrowup", ArrowDown: "arrowdown", ArrowLeft: "arrowleft", ArrowRight: "arrowright",
  };
  const PANEL = "Ping"; // label of the panel with the picture
  const COPY = "Copy"; // label of the button beside a text
  const TYPES_TEXT = "input:not([type=checkbox]):not([type=radio]), textarea, select, [contenteditable], [role=slider]";
  const POINTER_MS = 50;
  const FRAMES_MS = 2000; // between two reports of the slowest frame
  // The server lets go of keys, and sends no pictures, while it gets no state: of 50 pictures that wait, React, which
  // viser's page is made with, takes the last for an endless loop.
  const REPEAT_MS = 250;

  function row() {
    const label = [...document.querySelectorAll("label")].find((one) => one.textContent === FIELD);
    let element = label;
    while (element && !element.querySelector("input")) element = element.parentElement;
    return element;
  }

  function hideField() {
    const found = row();
    if (found) found.parentElement.style.display = "none";
  }

  // viser runs this again whenever it draws the panel anew
  if (window.sonarView) return window.sonarView.hideField();

  const state = { pointer: null, clicks: 0, clicked: null, keys: [], frame_s: 0, count: 0 };
  const held = new Set();
  const write = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;

  function send() {
    const field = row()?.querySelector("input");
    if (!field) return;
    state.keys = [...held];
    state.count += 1;
    write.call(field, JSON.stringify(state)); // React takes no notice of `field.value = ...`
    field.dispatchEvent(new Event("input", { bubbles: true }));
  }

  // a pointer moves more often than viser sends
  let isWaiting = false;
  function sendSoon() {
    if (isWaiting) return;
    isWaiting = true;
    setTimeout(() => {
      isWaiting = false;
      send();
    }, POINTER_MS);
  }

  // the picture is the page's only image that comes in parts of a message; its enlarged copy is another element
  const picture = (target) => (target instanceof HTMLImageElement && target.src.startsWith("blob:") ? target : null);

  // The picture stands in the middle of its panel, however narrow the fan, and leaves room for the numbers below it. On a
  // phone, where viser stacks the panels in a sheet, it comes before the controls.
  const STYLE = `
    img[src^="blob:"] { margin: 0 auto; max-height: max(200px, calc(100vh - 315px)); }
    [role=dialog] img[src^="blob:"] { max-height: none; }
    :has(> div > .mantine-Tabs-root > [aria-label$="panel ${PANEL}"]) { display: flex; flex-direction: column; }
    div:has(> .mantine-Tabs-root > [aria-label$="panel ${PANEL}"]) { order: -1; }
  `;
  document.head.append(Object.assign(document.createElement("style"), { textContent: STYLE }));

  // Lines of range and azimuth, which the server sends when they change, lie over the picture and its enlarged copy.
  const layers = new WeakMap(); // by image
  const sizes = new ResizeObserver(layMarks);

  function layMarks() {
    const html = document.querySelector("[data-marks]")?.innerHTML ?? "";
    for (const image of document.images) {
      if (picture(image) === null) continue;
      let layer = layers.get(image);
      if (!layer?.isConnected) {
        layer = Object.assign(document.createElement("div"), { className: "sonar-marks" });
        layer.style.cssText = "position: absolute; pointer-events: none;";
        image.after(layer);
        layers.set(image, layer);
        sizes.observe(image);
      }
      if (layer.drawnFrom !== html) layer.innerHTML = layer.drawnFrom = html;
      for (const [side, of] of [["left", "Left"], ["top", "Top"], ["width", "Width"], ["height", "Height"]]) {
        layer.style[side] = `${image[`offset${of}`]}px`;
      }
    }
  }

  function place(event, image) {
    const box = image.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  function point(event) {
    const image = picture(event.target);
    if (image === null && state.pointer === null) return;
    if (image !== null) image.style.cursor = "crosshair";
    state.pointer = image && place(event, image);
    sendSoon();
  }

  document.addEventListener("pointermove", point, true);
  document.addEventListener("pointerdown", point, true); // a finger that taps does not move

  document.addEventListener("click", (event) => {
    const image = picture(event.target);
    if (image === null) return;
    state.clicks += 1;
    state.clicked = place(event, image);
    send();
  }, true);

  // a browser lets a page write to the clipboard on a click alone, and only a page of this machine or of HTTPS
  document.addEventListener("click", (event) => {
    const button = event.target instanceof Element ? event.target.closest("button") : null;
    if (button?.textContent !== COPY) return;
    const text = button.closest("[role=dialog]")?.querySelector("textarea");
    if (!text) return;
    text.select(); // else Ctrl-C copies it
    navigator.clipboard?.writeText(text.value);
  }, true);

  // viser's page leaves a field empty that was emptied; it shows the number in force again, that of the slider beside it
  document.addEventListener("focusout", (event) => {
    const field = event.target;
    if (!(field instanceof HTMLInputElement) || Number.isFinite(parseFloat(field.value))) return;
    const slider = field.closest(".mantine-NumberInput-root")?.parentElement.querySelector("[role=slider]");
    if (!slider) return;
    write.call(field, slider.getAttribute("aria-valuenow"));
    field.dispatchEvent(new Event("input", { bubbles: true }));
  });

  document.addEventListener("dragstart", (event) => {
    if (picture(event.target)) event.preventDefault();
  }, true);

  // on the window, before viser's own listeners on the document
  window.addEventListener("keydown", (event) => {
    const switched = document.querySelector("[data-keys-move-sonar]");
    if (!switched || !(event.code in KEYS) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target instanceof Element && event.target.closest(TYPES_TEXT)) return;
    event.stopImmediatePropagation();
    event.preventDefault(); // arrows would scroll a panel
    if (held.has(KEYS[event.code])) return;
    held.add(KEYS[event.code]);
    send();
  }, true);

  window.addEventListener("keyup", (event) => {
    if (held.delete(KEYS[event.code])) send();
  }, true);

  window.addEventListener("blur", () => {
    if (held.size === 0) return;
    held.clear();
    send();
  });

  setInterval(() => {
    send();
    layMarks();
  }, REPEAT_MS);

  // Pictures that arrive wait for frames of the scene that are being drawn. Where those take long, as without a graphics
  // card, the server changes the scene less often.
  let slowest_ms = 0;
  let before_ms = performance.now();
  const measure = (now_ms) => {
    slowest_ms = Math.max(slowest_ms, now_ms - before_ms);
    before_ms = now_ms;
    requestAnimationFrame(measure);
  };
  requestAnimationFrame(measure);
  setInterval(() => {
    const frame_s = document.hidden ? 0 : Math.max(slowest_ms, performance.now() - before_ms) / 1000;
    slowest_ms = 0;
    if (Math.abs(frame_s - state.frame_s) <= 0.25 * state.frame_s) return;
    state.frame_s = frame_s;
  }, FRAMES_MS);

  window.sonarView = { hideField };
  hideField();
})();
