"""Fast: the scripted scenarios compiled by numba, many rows side by side, for rollouts and for steps of environments.

Torch (`rare_envs.simulation`) is the reference, and tests compare the two row by row. `choice` says what is compiled;
`rows` moves a block of rows by a tick; `rollouts` and `steps` call it. Only they need numba, and are imported when
something is compiled.
"""
