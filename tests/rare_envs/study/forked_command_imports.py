"""What a command imports in its course, for the server whose forks are the commands."""

import pyarrow.parquet
import sklearn.cluster
import torch

import rare_envs
import rare_envs.study.cli.app
import rare_envs.study.evaluate

__all__ = ["pyarrow", "rare_envs", "sklearn", "torch"]
