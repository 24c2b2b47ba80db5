// A server of an ego on msgpack.mjs and zmtp.mjs: the protocol of docs/egos.md, apart from what the ego decides.
import net from "node:net";
import { Malformed, pack, unpack } from "./msgpack.mjs";
import { send, speak } from "./zmtp.mjs";

function refuse(code, reason) {
  return Object.assign(new Error(reason), { code });
}

function readFloats(array) {
  const size = { "<f4": 4, "<f8": 8 }[array?.dtype];
  const shape = array?.shape;
  const fits = size && Array.isArray(shape) && shape.every((n) => Number.isSafeInteger(n) && n >= 0);
  if (!fits || !(array.data instanceof Uint8Array) || array.data.length !== size * shape.reduce((a, b) => a * b, 1))
    throw refuse("malformed", "expected an array of floats whose data fill its shape");
  const bytes = new Uint8Array(array.data).buffer; // a copy, aligned
  return size === 4 ? new Float32Array(bytes) : Float32Array.from(new Float64Array(bytes));
}

// One connection: its sessions are batches that have been reset.
function answerer(decide) {
  const sessions = new Map();
  let greeted = false;
  return (message) => {
    if (message.type === "hello") {
      if (message.protocol !== 1) throw refuse("version", `this ego speaks protocol 1, not ${message.protocol}`);
      greeted = true;
      return { type: "hello", protocol: 1, name: "javascript", observation: null, action: { shape: [2], low: [-1, -1], high: [1, 1] } };
    }
    if (!greeted) throw refuse("hello", "expected a hello first");
    if (message.type === "ping") return { type: "pong" };
    if (message.type === "end") {
      sessions.delete(message.session);
      return { type: "ended" };
    }
    if (message.type === "reset") {
      const good = Number.isSafeInteger(message.batch) && message.batch > 0 && Number.isSafeInteger(message.session);
      if (!good) throw refuse("malformed", "reset has a session and a batch");
      sessions.set(message.session, { batch: message.batch, step: 0 });
      if (sessions.size > 64) sessions.delete(sessions.keys().next().value);
      return { type: "ready" };
    }
    if (message.type !== "act") throw refuse("unknown", `unknown type ${message.type}`);
    const session = sessions.get(message.session);
    if (!session || session.step !== message.step) throw refuse("session", "unknown session or another step");
    const seen = message.observation?.parts?.features ?? message.observation; // of several kinds only this one matters
    const observation = readFloats(seen);
    const [batch, features] = seen.shape;
    if (batch !== session.batch || seen.shape.length !== 2 || features < 5)
      throw refuse("malformed", `expected ${session.batch} rows of 5 or more features`);
    session.step += 1;
    const actions = decide(observation, features);
    const data = new Uint8Array(actions.buffer);
    return { type: "action", action: { dtype: "<f4", shape: [batch, 2], data }, memory: false };
  };
}

function onConnection(socket, decide) {
  const answer = answerer(decide);
  speak(socket, "REP", (frames) => {
    const empty = frames.findIndex((body) => body.length === 0);
    const rest = frames.slice(empty + 1);
    let id = null;
    let reply;
    try {
      if (rest.length !== 1) throw new Malformed(`${rest.length} frames, expected 1`);
      const message = unpack(rest[0]);
      if (message === null || typeof message !== "object" || Array.isArray(message)) throw new Malformed("no map");
      if (!Number.isSafeInteger(message.id) || message.id < 0) throw new Malformed("id is a whole number");
      id = message.id;
      reply = answer(message);
    } catch (error) {
      reply = { type: "error", code: error.code ?? (error instanceof Malformed ? "malformed" : "internal"), reason: error.message };
    }
    send(socket, [...frames.slice(0, empty + 1), pack({ ...reply, id })]);
  });
}

// Serves decide(observation, features), from observations of B rows to Float32Array actions of 2 B numbers, at a port.
export function serve(decide, port) {
  const server = net.createServer((socket) => onConnection(socket, decide));
  server.listen(port, "127.0.0.1", () => console.log(`tcp://127.0.0.1:${server.address().port}`));
}
