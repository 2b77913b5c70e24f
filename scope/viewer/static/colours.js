// Colours: viridis for what grows, blue to red about zero for deviations, distinct ones for names; and of the parts of a rig.

const STOPS = {
  sequential: ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"],
  diverging: ["#1d3f8f", "#3f74c2", "#86b3e0", "#c9dcef", "#f3efe6", "#f5cdb4", "#e8936f", "#c94f3f", "#8c1524"],
};
const NAMED = ["#3d8fd1", "#e0862e", "#3aa655", "#b05cc2", "#c9b22b", "#d64f4f", "#3bb7b7", "#8a6d4b", "#7c7fd6", "#9a9a9a"];
const PARTS = { // on a light ground, on a dark one
  camera: ["#0b5cad", "#63b3ff"], ray: ["#58677a", "#a9b8c9"], volume: ["#7b6d3a", "#d9c877"], stage: ["#b35c00", "#ffb057"],
  model: ["#8b95a1", "#8b95a1"], box: ["#9aa5b1", "#46525f"], x: ["#c62828", "#ff7b72"], y: ["#1d7d36", "#5fd38d"], z: ["#2457c5", "#86adff"],
  mark: ["#c2185b", "#ff6fae"],
};
const SHEETS = [["#d1202f", "#ff5a63"], ["#198c3a", "#4fd87c"], ["#7a3bd1", "#b78bff"], ["#b36b00", "#ffb44d"]];

const channels = text => [1, 3, 5].map(k => parseInt(text.slice(k, k + 2), 16));

// RGBA bytes of a colour bar of 256 steps, or of one step for each name.
function barOf(column) {
  const names = column.kind === "names", count = names ? Math.max(1, column.names.length) : 256;
  const bytes = new Uint8Array(4 * count), stops = STOPS[column.kind] || STOPS.sequential;
  for (let i = 0; i < count; i++) {
    let rgb = channels(NAMED[i % NAMED.length]);
    if (!names) {
      const t = (i / 255) * (stops.length - 1), k = Math.min(stops.length - 2, Math.floor(t)), f = t - k;
      const [a, b] = [channels(stops[k]), channels(stops[k + 1])];
      rgb = a.map((x, c) => Math.round(x + f * (b[c] - x)));
    }
    bytes.set([...rgb, 255], 4 * i);
  }
  return bytes;
}
const partColour = (layer, dark) => (layer.role === "sheet" ? SHEETS[layer.number % SHEETS.length] : PARTS[layer.role] || PARTS.ray)[dark ? 1 : 0];
