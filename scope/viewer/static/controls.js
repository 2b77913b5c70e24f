// Mouse, fingers and keys. The page scrolls under a moving wheel and a moving finger unless the viewer was clicked or has the focus.

function addControls(viewer) {
  const {canvas, view, panel} = viewer, fingers = new Map();
  let moved = 0, last = null, pinched = null, drawing = false;

  const activate = (on, byKeys = false) => {
    viewer.byKeys = on && byKeys;
    viewer.active = on;
    viewer.stage.classList.toggle("active", on);
    viewer.draw();
  };
  viewer.outside = event => { if (!event.composedPath().includes(viewer)) activate(false); };
  document.addEventListener("pointerdown", viewer.outside, true);
  canvas.addEventListener("focus", () => { if (!fingers.size) activate(true, canvas.matches(":focus-visible")); });
  canvas.addEventListener("blur", () => activate(false));

  const place = event => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const pair = () => {
    const [[ax, ay], [bx, by]] = [...fingers.values()];
    return {x: (ax + bx) / 2, y: (ay + by) / 2, wide: Math.hypot(bx - ax, by - ay), angle: Math.atan2(by - ay, bx - ax)};
  };

  canvas.addEventListener("pointerdown", event => {
    if (event.pointerType !== "touch") { canvas.focus({preventScroll: true}); activate(true); }
    fingers.set(event.pointerId, place(event));
    canvas.setPointerCapture(event.pointerId);
    last = place(event);
    if (fingers.size === 1) { moved = 0; drawing = ["section", "region"].includes(viewer.mode) && event.button === 0 && !event.shiftKey; }
    if (fingers.size === 2) { pinched = pair(); drawing = false; viewer.drawn = null; moved = 99; }
    if (drawing) viewer.start = last;
  });

  canvas.addEventListener("pointermove", event => {
    if (!fingers.has(event.pointerId)) return;
    const now = place(event);
    fingers.set(event.pointerId, now);
    if (fingers.size === 2) {
      const pinch = pair(), turn = Math.atan2(Math.sin(pinch.angle - pinched.angle), Math.cos(pinch.angle - pinched.angle));
      view.move(pinch.x - pinched.x, pinch.y - pinched.y);
      view.zoom(pinch.wide / Math.max(1, pinched.wide), pinch.x, pinch.y);
      view.turn(0, 0, turn);
      pinched = pinch;
      activate(true);
      viewer.draw(true);
      return;
    }
    const [dx, dy] = [now[0] - last[0], now[1] - last[1]];
    moved += Math.hypot(dx, dy);
    last = now;
    if (moved < 4) return;
    if (drawing) { viewer.drawn = [viewer.start, now]; viewer.draw(); return; }
    if (event.shiftKey || event.buttons & 6) view.move(dx, dy);
    else if (event.ctrlKey) view.turn(0, 0, dx / 120);
    else view.turn((3.2 * dx) / view.height, (3.2 * dy) / view.height);
    viewer.draw(true);
  });

  const end = event => {
    if (!fingers.delete(event.pointerId)) return;
    if (event.type === "pointercancel") { drawing = false; viewer.drawn = null; return; }
    if (fingers.size) { last = [...fingers.values()][0]; return; }
    if (event.pointerType === "touch") { canvas.focus({preventScroll: true}); activate(true); }
    if (drawing && viewer.drawn && moved >= 12) {
      if (viewer.mode === "section") viewer.sectionThrough(...viewer.drawn);
      else viewer.regionOf(...viewer.drawn);
    } else if (moved < 4 && event.button === 0) viewer.choose(viewer.pickAt(...place(event), event.pointerType === "touch" ? 18 : 9));
    drawing = false;
  };
  canvas.addEventListener("pointerup", end);
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("contextmenu", event => event.preventDefault());

  const turnAbout = row => {
    if (row === null) return;
    view.turnAbout(viewer.cloud.point(row));
    viewer.draw();
    panel.tell("Turning about this point");
  };
  canvas.addEventListener("dblclick", event => turnAbout(viewer.pickAt(...place(event), 12)));

  canvas.addEventListener("wheel", event => {
    if (!viewer.active) { panel.tell("Click the picture: then the wheel zooms"); return; }
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 400 : 1;
    view.zoom(Math.exp(-Math.max(-400, Math.min(400, event.deltaY * lines)) * 0.0016), ...place(event));
    viewer.draw(true);
  }, {passive: false});

  const nudge = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};
  const keys = {
    "+": () => view.zoom(1.2), "=": () => view.zoom(1.2), "-": () => view.zoom(1 / 1.2), r: () => viewer.reset(), f: () => viewer.wholeScreen(),
    x: () => viewer.lookAlong("along x"), y: () => viewer.lookAlong("along y"), z: () => viewer.lookAlong("along z"),
    p: () => viewer.setMode("point"), d: () => viewer.setMode("distance"), s: () => viewer.setMode("section"),
    b: () => viewer.hasAttribute("region") && viewer.setMode("region"), "?": () => { panel.help.hidden = !panel.help.hidden; },
    c: () => turnAbout(viewer.pickAt(view.width / 2, view.height / 2, 24)), Enter: () => viewer.choose(viewer.pickAt(view.width / 2, view.height / 2, 24)),
    "[": () => viewer.slab && viewer.placeSection(panel.place.value / 1000 - 0.005), "]": () => viewer.slab && viewer.placeSection(panel.place.value / 1000 + 0.005),
    Escape: () => { if (viewer.picked.length || viewer.drawn) viewer.forget(); else canvas.blur(); },
  };
  canvas.addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (nudge[key]) {
      const [dx, dy] = nudge[key];
      if (event.shiftKey) view.move(30 * dx, 30 * dy);
      else view.turn(0.09 * dx, 0.09 * dy);
    } else if (keys[key] && (viewer.scene.points || !"pdsc".includes(key))) keys[key]();
    else return;
    event.preventDefault();
    viewer.byKeys = true;
    viewer.draw(true);
  });
}
