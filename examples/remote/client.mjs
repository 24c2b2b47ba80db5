// A client in JavaScript, without any package: asks an ego that python -m agents.remote serves for a few actions.
// node client.mjs PORT FEATURES [BATCH]; FEATURES is how many numbers to show it if it does not say what it observes.
import net from "node:net";
import { pack, unpack } from "./msgpack.mjs";
import { send, speak } from "./zmtp.mjs";

const [port, features, batch] = [process.argv[2], process.argv[3], process.argv[4] ?? 3].map(Number);
const socket = net.connect(port, "127.0.0.1");
let id = 0;
let waiting = null;
speak(socket, "REQ", (frames) => waiting(unpack(frames[frames.length - 1])));
socket.on("close", () => waiting({ type: "error", reason: "the server hung up" }));

function ask(message) {
  return new Promise((resolve, reject) => {
    waiting = (reply) => (reply.type === "error" ? reject(new Error(reply.reason)) : resolve(reply));
    send(socket, [Buffer.alloc(0), pack({ ...message, id: ++id })]);
  });
}

// Some numbers for a batch, in the space that the ego describes: an array, or of several kinds a map of arrays.
function observationOf(space) {
  if (space.parts) {
    const parts = Object.entries(space.parts).map(([name, part]) => [name, observationOf(part)]);
    return { parts: Object.fromEntries(parts) };
  }
  const shape = [batch, ...space.shape];
  const length = shape.reduce((a, b) => a * b, 1);
  if (space.dtype === "|u1") return { dtype: "|u1", shape, data: Uint8Array.from({ length }, (_, i) => i % 256) };
  const values = Float32Array.from({ length }, (_, i) => i / 10);
  return { dtype: "<f4", shape, data: new Uint8Array(values.buffer) };
}

const hello = await ask({ type: "hello", protocol: 1, client: "javascript" });
await ask({ type: "reset", session: 1, batch });
const observation = observationOf(hello.observation ?? { shape: [features] });
const { action } = await ask({ type: "act", session: 1, step: 0, observation });
await ask({ type: "end", session: 1 });
const bytes = new Uint8Array(action.data).buffer;
const numbers = { "<f4": Float32Array, "<f8": Float64Array, "<i8": BigInt64Array }[action.dtype];
const flat = Array.from(new numbers(bytes), Number);
console.log(JSON.stringify({ name: hello.name, shape: action.shape, action: flat }));
socket.end();
