"""Executors: where simulations are made. In this process, in local ones, on a cluster; the bits are the same."""

from samplers.execution.executors.base import Executor, ExecutorError, WorkerLost
from samplers.execution.executors.futures import FuturesPool
from samplers.execution.executors.in_process import InProcess
from samplers.execution.executors.local_processes import LocalProcesses
from samplers.execution.executors.ray_cluster import RayCluster

__all__ = ["Executor", "ExecutorError", "FuturesPool", "InProcess", "LocalProcesses", "RayCluster", "WorkerLost"]
