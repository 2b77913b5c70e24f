// The profile of a section: its points along it and across, with axes in mm; pointing at one shows where it is.

class Profile {
  constructor(canvas, onPick) {
    this.canvas = canvas; this.pen = canvas.getContext("2d"); this.onPick = onPick;
    canvas.addEventListener("pointermove", e => this.point(e));
    canvas.addEventListener("pointerleave", () => { this.near = -1; this.draw(); });
    canvas.addEventListener("click", e => { this.point(e); if (this.near >= 0) onPick(this.rows[this.near]); });
    this.near = -1;
  }

  // Points (rows) at (s, t) mm; `labels` of both axes; `colours` of the page.
  show(rows, s, t, labels, colours, downwards) {
    const order = Uint32Array.from(rows.keys()).sort((a, b) => s[a] - s[b]);
    this.rows = Array.from(order, k => rows[k]);
    this.s = Float64Array.from(order, k => s[k]);
    this.t = Float64Array.from(order, k => t[k]);
    Object.assign(this, {labels, downwards, near: -1});
    this.colours = colours;
    this.draw();
  }

  span(values) {
    let low = Infinity, high = -Infinity;
    for (const v of values) { if (v < low) low = v; if (v > high) high = v; }
    const margin = 0.05 * (high - low) || 1e-3;
    return [low - margin, high + margin];
  }

  draw() {
    const {canvas, pen} = this, ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !this.rows) return;
    canvas.width = width * ratio; canvas.height = height * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.font = "11px system-ui, sans-serif";
    const {ink, soft, edge, dot, mark} = this.colours, left = 58, right = 10, top = 8, bottom = 36;
    if (!this.rows.length) { pen.fillStyle = soft; pen.fillText("No point lies within the section.", 12, 24); return; }
    const [s0, s1] = this.span(this.s), [t0, t1] = this.span(this.t);
    this.x = s => left + ((s - s0) / (s1 - s0)) * (width - left - right);
    this.y = t => { const up = (t - t0) / (t1 - t0); return height - bottom - (this.downwards ? 1 - up : up) * (height - top - bottom); };
    const ticks = (low, high, room) => { const step = roundStep((high - low) / room), all = [];
      for (let v = Math.ceil(low / step) * step; v <= high; v += step) all.push([v, figure(v, decimalsOf(step))]); return all; };
    pen.strokeStyle = edge; pen.lineWidth = 1; pen.fillStyle = soft; pen.textBaseline = "middle";
    for (const [v, text] of ticks(s0, s1, Math.max(2, width / 90))) {
      pen.beginPath(); pen.moveTo(this.x(v), top); pen.lineTo(this.x(v), height - bottom); pen.stroke();
      pen.textAlign = "center"; pen.fillText(text, this.x(v), height - bottom + 11);
    }
    for (const [v, text] of ticks(t0, t1, Math.max(2, height / 45))) {
      pen.beginPath(); pen.moveTo(left, this.y(v)); pen.lineTo(width - right, this.y(v)); pen.stroke();
      pen.textAlign = "right"; pen.fillText(text, left - 5, this.y(v));
    }
    pen.fillStyle = ink; pen.textAlign = "center"; pen.fillText(this.labels[0], (left + width) / 2, height - 8);
    pen.save(); pen.translate(10, (height - bottom) / 2); pen.rotate(-Math.PI / 2); pen.fillText(this.labels[1], 0, 0); pen.restore();
    pen.fillStyle = dot;
    for (let i = 0; i < this.s.length; i++) pen.fillRect(this.x(this.s[i]) - 1, this.y(this.t[i]) - 1, 2, 2);
    if (this.near >= 0) {
      const [x, y] = [this.x(this.s[this.near]), this.y(this.t[this.near])];
      pen.beginPath(); pen.arc(x, y, 5, 0, 7); pen.strokeStyle = mark; pen.lineWidth = 2; pen.stroke();
      const text = `${this.s[this.near].toFixed(4)}, ${this.t[this.near].toFixed(4)} mm`;
      pen.fillStyle = mark; pen.textAlign = x > width / 2 ? "right" : "left";
      pen.fillText(text, x + (x > width / 2 ? -9 : 9), Math.max(top + 8, y - 10));
    }
  }

  point(event) {
    if (!this.rows || !this.rows.length) return;
    const box = this.canvas.getBoundingClientRect(), px = event.clientX - box.left, py = event.clientY - box.top;
    let best = 18 * 18;
    this.near = -1;
    for (let i = 0; i < this.s.length; i++) {
      const off = (this.x(this.s[i]) - px) ** 2 + (this.y(this.t[i]) - py) ** 2;
      if (off < best) { best = off; this.near = i; }
    }
    this.draw();
  }

  csv() {
    return [this.labels.map(l => `"${l}"`).join(","), ...Array.from(this.s, (s, i) => `${s.toFixed(6)},${this.t[i].toFixed(6)}`)].join("\n") + "\n";
  }
}
