// Bytes to a scene: base64, inflated, a header in JSON, then the columns as differences in byte planes (scope/viewer/payload.py).

function bytesOf(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function decoded(bytes, at, n, told, out, stride, offset) {
  const nothing = told.planes < 4 ? new Uint8Array(n) : null;
  const plane = k => (k < told.planes ? bytes.subarray(at + k * n, at + (k + 1) * n) : nothing);
  const [p0, p1, p2, p3] = [plane(0), plane(1), plane(2), plane(3)];
  let whole = 0;
  for (let i = 0, j = offset; i < n; i++, j += stride) {
    const u = p0[i] | (p1[i] << 8) | (p2[i] << 16) | (p3[i] << 24);
    whole = (whole + ((u >>> 1) ^ -(u & 1))) | 0;
    out[j] = told.start + told.step * whole;
  }
  at += told.planes * n;
  if (told.gaps) {
    for (let i = 0, j = offset; i < n; i++, j += stride) if (bytes[at + (i >> 3)] & (128 >> (i & 7))) out[j] = NaN;
    at += (n + 7) >> 3;
  }
  return at;
}

async function readScene(bytes) {
  const data = await inflated(bytes), size = new DataView(data.buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + size)));
  const n = header.points, xyz = new Float32Array(3 * n), columns = [];
  let at = 4 + size;
  header.axes.forEach((told, k) => { at = decoded(data, at, n, told, xyz, 3, k); });
  for (const told of header.columns) {
    const values = new Float32Array(n);
    at = decoded(data, at, n, told, values, 1, 0);
    columns.push({...told, values});
  }
  if (header.rows) {
    const numbers = new Float64Array(n);
    at = decoded(data, at, n, header.rows, numbers, 1, 0);
    header.numbers = row => numbers[row];
  }
  for (const told of header.places) { // z, x and y are in the points already
    const values = new Float32Array(n);
    for (let i = 0; i < n; i++) values[i] = xyz[3 * i + told.axis] + header.centre[told.axis];
    columns.push({...told, values});
  }
  return {...header, xyz, columns};
}

// Value with as many decimals as its column resolves.
function figure(value, decimals) {
  if (!Number.isFinite(value)) return "not known";
  const text = value.toFixed(Math.max(0, decimals));
  return /^-0(\.0*)?$/.test(text) ? text.slice(1) : text;
}
const named = (column, value) => (column.names && column.names[value] !== undefined ? column.names[value] : figure(value, column.decimals));

// A step of 1, 2 or 5 times a power of ten, at least as large as asked.
function roundStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find(m => m * power >= least * 0.999999);
}
const decimalsOf = step => Math.max(0, Math.min(9, Math.ceil(-Math.log10(step) - 1e-9)));
