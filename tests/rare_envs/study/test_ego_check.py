"""check-ego: one broken ego for each rule, and none that ends the check; conformance of a server to the protocol."""

from __future__ import annotations

import json
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import Result

import agents
from agents.safe_pickle import find_origin_risks
from rare_envs.study.arguments import Question
from rare_envs.study.ego_check import check_ego, exit_code, run_checks
from rare_envs.study.probe import Finding
from tests.rare_envs.study.refusals import in_file

Cli = Callable[..., Result]
ENV = "rare_envs/CarFollowing-v0"
EGOS = """
import os
import time

import numpy as np
from gymnasium import spaces

BOX = spaces.Box(-5.0, 5.0, (11,), np.float32)
ACTS = spaces.Box(-1.0, 1.0, (2,), np.float32)
CALLS = []


def made(predict, observation_space=BOX, action_space=ACTS):
    class Ego:
        pass
    ego = Ego()
    ego.observation_space, ego.action_space = observation_space, action_space
    ego.predict = lambda observation, state=None, episode_start=None, deterministic=True: predict(
        observation, state, episode_start)
    return ego


def braking(observation, *_):
    return np.stack((observation[:, 3] - 0.5, 0.0 * observation[:, 0]), axis=1), None


def good_with_memory():
    def predict(observation, state, start):
        least = observation[:, 3] if state is None else np.minimum(observation[:, 3], np.where(start, np.inf, state))
        return np.stack((least - 0.5, 0.0 * least), axis=1), least
    return made(predict)

def hidden_memory():
    def predict(observation, *_):
        action = braking(observation)[0] + (len(CALLS) and not np.array_equal(CALLS[-1], observation))
        CALLS.append(observation)
        return action, None
    return made(predict)

def never_begins_anew():
    def predict(observation, state, start):
        total = observation[:, 3] + (0.0 if state is None else state)
        return np.stack((total - 0.5, 0.0 * total), axis=1), total
    return made(predict)

def leaking():
    def predict(observation, *_):
        CALLS.append(np.ones(100_000))
        return braking(observation)
    return made(predict)

def acting(act):  # an ego without memory
    return lambda: made(lambda observation, *_: (act(observation, braking(observation)[0]), None))

good = lambda: made(braking)
good_without_spaces = lambda: made(braking, None, None)
another_unit = lambda: made(braking, action_space=spaces.Box(-5.0, 5.0, (2,), np.float32))
another_shape = lambda: made(braking, spaces.Box(-5.0, 5.0, (8,), np.float32))
lies_about_actions = lambda: made(braking, action_space=spaces.Discrete(5))
lies_about_observations = acting(lambda seen, _: seen @ np.ones((12, 2)))
short = acting(lambda _, action: action[:-1])
nan = acting(lambda _, action: action * np.nan)
nan_at_zero = acting(lambda seen, action: action / np.abs(seen).max(axis=1)[:, None])
constant = acting(lambda _, action: 0.0 * action)
random = acting(lambda _, action: action + np.random.normal(size=action.shape))
looks_at_others = acting(lambda seen, _: braking(seen - seen.mean(axis=0))[0])
looks_at_order = acting(lambda seen, action: action + 0.01 * np.arange(len(seen))[:, None])
wild = acting(lambda seen, action: np.ones_like(action) * np.sign(seen[:, 3:4]))
raising = acting(lambda *_: {}["no weights"])
dying = acting(lambda *_: os._exit(9))
hanging = acting(lambda *_: time.sleep(100))
no_ego = lambda: 7
"""


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module with egos of every kind; its name."""
    monkeypatch.chdir(tmp_path)
    name = f"broken_egos_{os.getpid()}_{abs(hash(str(tmp_path))) % 10**6}"
    (tmp_path / f"{name}.py").write_text(EGOS)
    return name


def findings(ego: str) -> dict[str, Finding]:
    return {each.check: each for each in run_checks(Question(env_id=ENV, ego=ego)) if isinstance(each, Finding)}


@pytest.mark.parametrize(
    ("ego", "check", "status", "found"),
    [
        ("good_without_spaces", "spaces", "warn", "no observation_space and action_space"),
        ("another_unit", "action space", "warn", "from [-5.0, -5.0] to [5.0, 5.0]"),
        ("another_shape", "loading", "fail", "expects observations"),
        ("lies_about_actions", "actions", "fail", "says Discrete(5)"),
        ("lies_about_observations", "actions", "fail", "ValueError"),
        ("short", "actions", "fail", "shape (31, 2)"),
        ("nan", "actions", "fail", "NaN or infinite for 32 of 32"),
        ("nan_at_zero", "range", "fail", "zeros: NaN"),
        ("constant", "actions", "warn", "the same for all"),
        ("random", "determinism", "warn", "vary from call to call"),
        ("hidden_memory", "determinism", "fail", "depend on earlier calls"),
        ("looks_at_others", "size of the batch", "fail", "change with it"),
        ("looks_at_order", "order of the batch", "fail", "change with it"),
        ("never_begins_anew", "memory", "warn", "rows that begin an episode are off"),
        ("wild", "driving", "warn", "collides in"),
        ("leaking", "space", "warn", "MB more after 100 calls"),
        ("raising", "actions", "fail", "KeyError: 'no weights'"),
        ("no_ego", "loading", "fail", "got int from"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_each_rule_finds_the_ego_that_breaks_it(broken: str, ego: str, check: str, status: str, found: str) -> None:
    result = findings(f"{broken}:{ego}")
    assert result[check].status == status, result
    assert found in result[check].found or (check == "actions" and result[check].found), result[check]
    assert result[check].advice
    assert exit_code(list(result.values())) in ((2,) if status == "fail" else (0, 2, 3))


@pytest.mark.parametrize("ego", ["good", "good_with_memory"])
def test_a_good_ego_passes(broken: str, ego: str) -> None:
    result = findings(f"{broken}:{ego}")
    assert {each.status for each in result.values()} == {"pass"}, result
    assert {"memory", "determinism", "latency", "driving", "space"} <= set(result)
    assert exit_code(list(result.values())) == 0
    assert ("none" in result["memory"].found) == (ego == "good")
    assert re.search(r": (under 1 s|[1-9]\d* s) for 6000 simulations", result["latency"].found)


@pytest.mark.parametrize("ego", ["idm", "noisy:idm", "gail"])
def test_egos_without_predict_are_driven_only(ego: str) -> None:
    result = findings(ego)
    assert result["driving"].status == "pass"
    assert {each.status for each in result.values()} == {"pass"}


@pytest.mark.parametrize("ego", ["dying", pytest.param("hanging", marks=pytest.mark.slow)])
def test_the_check_outlives_the_ego(broken: str, ego: str, cli: Cli) -> None:
    result = cli("check-ego", f"{broken}:{ego}", ENV, "--time-limit", 2, "--json")
    answer = json.loads(result.stdout)
    assert result.exit_code == 2
    last = answer["findings"][-1]
    assert (last["check"], last["status"]) == ("actions", "fail")
    assert ("exit status 9" if ego == "dying" else "no end after 2 s") in last["found"]
    assert "process:EGO" in last["advice"]


LIARS = """
import numpy as np

class Base:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), np.float32), None

def made(**more):
    return lambda: type("Liar", (Base,), more)()

def boom(self):
    raise RuntimeError("boom")

observes_words = made(observation_space="Box")
space_raises = made(observation_space=property(boom))
no_method = made(predict=7)
three_results = made(predict=lambda self, *a, **k: (None, None, None))
objects = made(predict=lambda self, o, **k: (np.full((len(o), 2), None), None))
no_driver = made(in_world=property(boom), ego="idm", noise_columns=lambda self, world: 0)
"""


def test_an_ego_that_is_not_what_it_says_is_one_line_and_one_finding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "liars_here.py").write_text(LIARS)
    for name in [line.partition(" =")[0] for line in LIARS.splitlines() if " = made(" in line]:
        ego = f"liars_here:{name}"
        result = cli("estimate", ENV, "--ego", ego, "--method", "mc", "--max-sim", 5, *in_file(horizon=1))
        assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (2, "", 1), (name, result.output)
        found = [each for each in run_checks(Question(env_id=ENV, ego=ego, horizon=1.0)) if isinstance(each, Finding)]
        assert exit_code(found) == 2, (name, found)


# --- where files come from ---------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    from stable_baselines3 import PPO

    import training

    PPO("MlpPolicy", training.sb3_vec_env(ENV, 2), n_steps=8, batch_size=16, device="cpu").save(tmp_path / "ego.zip")
    return tmp_path / "ego.zip"


@pytest.mark.parametrize("what", ["file", "statistics"])
def test_a_zip_that_others_can_write_to_is_refused_by_every_command(what: str, saved: Path, cli: Cli) -> None:
    statistics = saved.with_name("vecnormalize.pkl")
    if what == "statistics":
        statistics.write_bytes(b"")
    assert find_origin_risks(saved, statistics) == []
    path = saved if what == "file" else statistics
    path.chmod(path.stat().st_mode | 0o002)
    (doubt,) = find_origin_risks(saved, statistics)
    refused = cli("check-ego", saved, ENV, "--json")
    (finding,) = json.loads(refused.stdout)["findings"]
    assert (refused.exit_code, finding["check"], finding["status"]) == (2, "origin", "fail")
    assert finding["found"] == doubt
    assert "writable by everybody" in doubt
    commands: list[list[Any]] = [
        ["estimate", ENV, "--ego", saved],
        ["estimate", ENV, "--ego", f"noisy:{saved}?lag=1"],
        ["compare", "idm", saved, ENV],
        ["export", saved, saved.with_suffix(".onnx")],
    ]
    for words in commands:
        said = cli(*words)
        assert (said.exit_code, said.stdout) == (2, "")
        assert f"Will not open it: {doubt}; {finding['advice']}." in said.stderr
    with pytest.raises(
        ValueError, match=r"is writable by everybody.*copy it to a folder of your own.*any code in it runs"
    ):
        agents.load_ego(saved)


def test_a_zip_of_ones_own_is_no_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ego.zip").touch()
    monkeypatch.setattr("rare_envs.study.ego_check._check_in_subprocess", lambda *_: iter(()))
    (origin,) = check_ego(Question(env_id=ENV, ego="ego.zip"))
    assert (origin.check, origin.status) == ("origin", "pass")
    (trusted,) = check_ego(Question(env_id=ENV, ego="ego.zip", trust=True))
    assert trusted.status == "warn" and "any code in it runs" in trusted.advice


@pytest.mark.slow
def test_trust_opens_it_all_the_same(saved: Path, cli: Cli) -> None:
    saved.chmod(0o666)
    found = json.loads(cli("check-ego", saved, ENV, "--json", "--trust").stdout)["findings"]
    assert [each["status"] for each in found[:2]] == ["warn", "pass"]
    assert "writable by everybody" in found[0]["found"]
    assert "any code in it runs" in found[0]["advice"]
    out = saved.parent / "run"
    words = ("estimate", ENV, "--ego", saved, "--method", "mc", "--max-sim", 50, "--gamma", 9, "--out", out)
    assert cli(*words, "--trust").exit_code in (0, 3)
    assert "writable by everybody" in cli("replay", out).stderr
    assert cli("replay", out, "--trust").exit_code in (0, 3)


def test_a_server_that_keeps_to_the_protocol_passes() -> None:
    pytest.importorskip("zmq", reason="the extra remote is optional")
    from agents.remote.server import EgoServer

    class Good:
        def predict(self, observation: Any, **_: Any) -> Any:
            return np.stack((observation[:, 3] - 0.5, 0.0 * observation[:, 0]), axis=1), None

    with EgoServer(Good(), "tcp://127.0.0.1:*") as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            result = findings(f"{server.address}?timeout=20")
            handle = server._handler.handle

            def forgetful(connection: bytes, request: bytes) -> bytes:
                """Answers a step that is not the next as if it were."""
                from agents.remote import protocol

                content = handle(connection, request)
                message = protocol.unpack(content)
                if message.get("code") == "session":
                    return protocol.pack({"type": "action", "id": message["id"]})
                return content

            server._handler.handle = forgetful  # type: ignore[method-assign]
            worse = findings(f"{server.address}?timeout=20")
        finally:
            server.stop()
            thread.join()
    assert {each.status for each in result.values()} == {"pass", "warn"}, result
    assert result["handshake"].found == "protocol 1, 'ego'"
    assert {"heartbeat", "two sessions", "cut short", "driving"} <= set(result)
    assert worse["another step"].status == worse["no reset"].status == "fail"
    nobody = findings(f"{server.address}?timeout=0.3&patience=0.3")
    assert "is it running" in nobody["protocol"].advice


def test_a_check_without_a_finding_is_one_line(cli: Cli) -> None:
    said = cli("check-ego", "idm", "CutIn").stdout
    assert said == "idm in rare_envs/CutIn-v1 can be used: 2 checks passed (details: --all)\n"
    assert "driving" in cli("check-ego", "idm", "CutIn", "--all").stdout
