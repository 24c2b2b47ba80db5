// ZeroMQ's wire protocol, ZMTP 3.0 without encryption (https://rfc.zeromq.org/spec/23), as far as REQ and REP need it.

const MAX_FRAME = 256 * 2 ** 20;
const GREETING = Buffer.alloc(64);
GREETING[0] = 0xff;
GREETING[9] = 0x7f;
GREETING[10] = 3; // version 3.0
GREETING.write("NULL", 12);
const [MORE, LONG, COMMAND] = [1, 2, 4];

function frame(flags, body) {
  const head = Buffer.alloc(body.length > 255 ? 9 : 2);
  head[0] = flags | (body.length > 255 ? LONG : 0);
  if (body.length > 255) head.writeBigUInt64BE(BigInt(body.length), 1);
  else head[1] = body.length;
  return Buffer.concat([head, body]);
}

function ready(type) {
  const size = Buffer.from([0, 0, 0, type.length]);
  return frame(COMMAND, Buffer.concat([Buffer.from("\x05READY\x0bSocket-Type"), size, Buffer.from(type)]));
}

const early = new WeakMap(); // what waits for the other side's READY; libzmq hangs up on who does not wait

export function send(socket, frames) {
  const bytes = Buffer.concat(frames.map((body, i) => frame(i < frames.length - 1 ? MORE : 0, body)));
  if (early.has(socket)) early.get(socket).push(bytes);
  else socket.write(bytes);
}

// Speak ZMTP on a TCP socket; onMessage gets the frames of each message. Whoever breaks the rules is disconnected.
export function speak(socket, type, onMessage) {
  let buffer = Buffer.alloc(0);
  let greeted = false;
  let frames = [];
  early.set(socket, []);
  socket.setNoDelay(true);
  socket.on("error", () => socket.destroy());
  socket.write(GREETING);
  socket.write(ready(type));
  socket.on("data", (data) => {
    buffer = buffer.length ? Buffer.concat([buffer, data]) : data;
    if (!greeted) {
      if (buffer.length < 64) return;
      const known = buffer[0] === 0xff && buffer[9] === 0x7f && buffer[10] >= 3;
      if (!known || buffer.toString("latin1", 12, 17) !== "NULL\0") return socket.destroy();
      buffer = buffer.subarray(64);
      greeted = true;
    }
    while (buffer.length >= 2) {
      const flags = buffer[0];
      const long = Boolean(flags & LONG);
      if (long && buffer.length < 9) return;
      const size = long ? Number(buffer.readBigUInt64BE(1)) : buffer[1];
      const start = long ? 9 : 2;
      if (flags > 7 || size > MAX_FRAME || frames.length > 8) return socket.destroy();
      if (buffer.length < start + size) return;
      const body = buffer.subarray(start, start + size);
      buffer = buffer.subarray(start + size);
      if (flags & COMMAND) {
        // READY, and what later versions add
        for (const bytes of early.get(socket) ?? []) socket.write(bytes);
        early.delete(socket);
        continue;
      }
      frames.push(body);
      if (flags & MORE) continue;
      const message = frames;
      frames = [];
      onMessage(message);
    }
  });
}
