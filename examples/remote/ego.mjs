// An ego in JavaScript, without any package: node ego.mjs [port]. Then: rare-envs estimate ENV --ego tcp://127.0.0.1:PORT
import { serve } from "./serve.mjs";

// Keeps 1.5 s behind the vehicle ahead; see docs/environments.md for what is observed.
function decide(observation, features) {
  const actions = new Float32Array(2 * (observation.length / features));
  for (let row = 0; row < actions.length / 2; row++) {
    const [speed, y, heading, gap, relativeSpeed] = observation.subarray(row * features, row * features + 5);
    const wanted = 0.5 * (50 * gap - 1.5 * 30 * speed) + 10 * relativeSpeed; // [m/s^2]
    actions[2 * row] = Math.max(-1, Math.min(1, wanted / 5));
    actions[2 * row + 1] = Math.max(-1, Math.min(1, -0.2 * y - 0.5 * heading));
  }
  return actions;
}

serve(decide, Number(process.argv[2] ?? 5555));
