"""`python -m rare_envs` is the command line `rare-envs`."""

from rare_envs.study.cli import main

if __name__ == "__main__":
    main()
