"""An ego that fails near a certain gap, in one of the ways in which egos fail, as text for a module."""

FAULTY = """
import os, signal, sys, time
import numpy as np


class Faulty:
    def __init__(self, fail):
        self.fail = fail

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        gap = observation[:, 3]
        actions = np.stack((np.minimum(gap - 0.3, 0.0), 0.0 * gap), axis=1)
        bad = np.abs(gap - 0.55) < 0.00005
        if bad.any():
            self.fail(actions, bad)
        return actions, None


def give_nan(actions, bad):
    actions[bad] = np.nan


def stop(actions, bad):
    raise ArithmeticError("off the map")


def sleep(actions, bad):
    time.sleep(3600)


def leave(actions, bad):
    os._exit(3)


def die(actions, bad):
    os.kill(os.getpid(), signal.SIGSEGV)


def eat(actions, bad):
    kept = []
    while True:
        kept.append(bytearray(1 << 28))


def nan():
    return Faulty(give_nan)


def raising():
    return Faulty(stop)


def hanging():
    return Faulty(sleep)


def exiting():
    return Faulty(leave)


def crashing():
    return Faulty(die)


def hungry():
    return Faulty(eat)
"""
