"""An ego as a program of its own, on pyzmq, msgpack and NumPy: python examples/remote/ego.py [PORT]."""

import sys

import msgpack
import numpy as np
import zmq

HELLO = {"type": "hello", "protocol": 1, "name": "python", "observation": None, "action": None}
REPLIES = {"hello": HELLO, "ping": {"type": "pong"}, "reset": {"type": "ready"}, "end": {"type": "ended"}}


def answer(message: dict, sessions: dict) -> dict:
    """Answer a message of docs/egos.md: keep 1.5 s behind the vehicle ahead, by docs/environments.md's features."""
    if message["type"] != "act":
        sessions[message.get("session")] = (message.get("batch"), 0)
        return REPLIES[message["type"]]
    (batch, step), given = sessions[message["session"]], message["observation"]
    speed, y, heading, gap, relative = np.frombuffer(given["data"], given["dtype"]).reshape(given["shape"])[:, :5].T
    assert (len(speed), message["step"]) == (batch, step), "another batch or step than the next"
    sessions[message["session"]] = (batch, step + 1)
    accelerate = 0.1 * (50 * gap - 1.5 * 30 * speed) + 2 * relative  # of 5 m/s^2
    action = np.stack((accelerate, -0.2 * y - 0.5 * heading), axis=1).clip(-1, 1).astype("<f4").tobytes()
    return {"type": "action", "action": {"dtype": "<f4", "shape": [batch, 2], "data": action}, "memory": False}


socket, clients = zmq.Context().socket(zmq.ROUTER), {}
socket.bind(f"tcp://127.0.0.1:{sys.argv[1] if len(sys.argv) > 1 else 5555}")
print(socket.last_endpoint.decode(), flush=True)
while True:
    who, *empty, content = socket.recv_multipart()
    message = {}
    try:
        message = msgpack.unpackb(content)
        reply = answer(message, clients.setdefault(who, {}) if message["type"] == "hello" else clients[who])
    except Exception as error:  # whatever came: the next message may be a good one
        reply = {"type": "error", "code": "session" if type(error) is KeyError else "malformed", "reason": repr(error)}
    socket.send_multipart([who, *empty, msgpack.packb({**reply, "id": getattr(message, "get", {}.get)("id")})])
