// The part of msgpack (https://msgpack.org) that docs/egos.md uses: null, booleans, numbers, text, bytes, lists, maps.

export class Malformed extends Error {}

export function pack(value) {
  const parts = [];
  write(value, parts);
  return Buffer.concat(parts);
}

function head(parts, tag, size, bytes) {
  const part = Buffer.alloc(1 + bytes);
  part[0] = tag;
  part.writeUIntBE(size, 1, bytes);
  parts.push(part);
}

function write(value, parts) {
  if (value === null || value === undefined) parts.push(Buffer.from([0xc0]));
  else if (typeof value === "boolean") parts.push(Buffer.from([value ? 0xc3 : 0xc2]));
  else if (typeof value === "number" && Number.isSafeInteger(value) && value >= 0 && value < 128) parts.push(Buffer.from([value]));
  else if (typeof value === "number") {
    const part = Buffer.alloc(9);
    const whole = Number.isSafeInteger(value);
    part[0] = whole ? 0xd3 : 0xcb;
    if (whole) part.writeBigInt64BE(BigInt(value), 1);
    else part.writeDoubleBE(value, 1);
    parts.push(part);
  } else if (typeof value === "string") {
    const text = Buffer.from(value);
    head(parts, 0xdb, text.length, 4);
    parts.push(text);
  } else if (value instanceof Uint8Array) {
    head(parts, 0xc6, value.length, 4);
    parts.push(value);
  } else if (Array.isArray(value)) {
    head(parts, 0xdd, value.length, 4);
    for (const item of value) write(item, parts);
  } else {
    const entries = Object.entries(value);
    head(parts, 0xdf, entries.length, 4);
    for (const [key, item] of entries) {
      write(key, parts);
      write(item, parts);
    }
  }
}

export function unpack(bytes) {
  const reader = { bytes, at: 0 };
  const value = read(reader, 0);
  if (reader.at !== bytes.length) throw new Malformed("bytes left over");
  return value;
}

function take(reader, size) {
  if (reader.at + size > reader.bytes.length) throw new Malformed("cut short");
  reader.at += size;
  return reader.bytes.subarray(reader.at - size, reader.at);
}

const number = (reader, bytes) => take(reader, bytes).readUIntBE(0, bytes);
const text = (reader, size) => take(reader, size).toString("utf8");

function list(reader, size, depth) {
  const items = [];
  for (let i = 0; i < size; i++) items.push(read(reader, depth + 1));
  return items;
}

function map(reader, size, depth) {
  const items = Object.create(null);
  for (let i = 0; i < size; i++) {
    const key = read(reader, depth + 1);
    if (typeof key !== "string") throw new Malformed("a key that is no text");
    items[key] = read(reader, depth + 1);
  }
  return items;
}

function read(reader, depth) {
  if (depth > 8) throw new Malformed("too deep");
  const tag = take(reader, 1)[0];
  if (tag < 0x80) return tag;
  if (tag < 0x90) return map(reader, tag & 0x0f, depth);
  if (tag < 0xa0) return list(reader, tag & 0x0f, depth);
  if (tag < 0xc0) return text(reader, tag & 0x1f);
  if (tag >= 0xe0) return tag - 256;
  const readers = {
    0xc0: () => null,
    0xc2: () => false,
    0xc3: () => true,
    0xc4: () => take(reader, number(reader, 1)),
    0xc5: () => take(reader, number(reader, 2)),
    0xc6: () => take(reader, number(reader, 4)),
    0xca: () => take(reader, 4).readFloatBE(0),
    0xcb: () => take(reader, 8).readDoubleBE(0),
    0xcc: () => number(reader, 1),
    0xcd: () => number(reader, 2),
    0xce: () => number(reader, 4),
    0xcf: () => Number(take(reader, 8).readBigUInt64BE(0)),
    0xd0: () => take(reader, 1).readInt8(0),
    0xd1: () => take(reader, 2).readInt16BE(0),
    0xd2: () => take(reader, 4).readInt32BE(0),
    0xd3: () => Number(take(reader, 8).readBigInt64BE(0)),
    0xd9: () => text(reader, number(reader, 1)),
    0xda: () => text(reader, number(reader, 2)),
    0xdb: () => text(reader, number(reader, 4)),
    0xdc: () => list(reader, number(reader, 2), depth),
    0xdd: () => list(reader, number(reader, 4), depth),
    0xde: () => map(reader, number(reader, 2), depth),
    0xdf: () => map(reader, number(reader, 4), depth),
  };
  if (!(tag in readers)) throw new Malformed(`tag ${tag}`);
  return readers[tag]();
}
