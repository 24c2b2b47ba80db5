// A client in JavaScript, without any package: asks an ego that rare-envs serve-ego lends for a few actions.
// node client.mjs PORT FEATURES [BATCH]
import net from "node:net";
import { pack, unpack } from "./msgpack.mjs";
import { send, speak } from "./zmtp.mjs";

const [port, features, batch] = [process.argv[2], process.argv[3], process.argv[4] ?? 3].map(Number);
const socket = net.connect(port, "127.0.0.1");
let id = 0;
let waiting = null;
speak(socket, "REQ", (frames) => waiting(unpack(frames[frames.length - 1])));

function ask(message) {
  return new Promise((resolve, reject) => {
    waiting = (reply) => (reply.type === "error" ? reject(new Error(reply.reason)) : resolve(reply));
    send(socket, [Buffer.alloc(0), pack({ ...message, id: ++id })]);
  });
}

const values = Float32Array.from({ length: batch * features }, (_, i) => Math.fround(i / 10));
const hello = await ask({ type: "hello", protocol: 1, client: "javascript" });
await ask({ type: "reset", session: 1, batch });
const observation = { dtype: "<f4", shape: [batch, features], data: new Uint8Array(values.buffer) };
const { action } = await ask({ type: "act", session: 1, step: 0, observation });
await ask({ type: "end", session: 1 });
const bytes = new Uint8Array(action.data).buffer;
const numbers = { "<f4": Float32Array, "<f8": Float64Array, "<i8": BigInt64Array }[action.dtype];
const flat = Array.from(new numbers(bytes), Number);
console.log(JSON.stringify({ name: hello.name, shape: action.shape, action: flat }));
socket.end();
