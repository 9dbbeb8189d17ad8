"""Flags that commands of the laboratory share."""

from pathlib import Path

from pydantic import BaseModel

from edgegrasp_cli.flags import ConnectionFlags


class ClusterFlags(BaseModel, use_attribute_docstrings=True):
    """The flags that choose the engine, the processes and the cluster."""

    engine: str | None = None
    """pybullet or mujoco; default: the protocol's, or the installed engine"""
    workers: int | None = None
    """Number of processes, without effect on results; default: one per core"""
    ray: str | None = None
    """Address of a Ray cluster to run on; local: this machine"""


class PlannerFlags(ConnectionFlags):
    """The flags that choose a planner of the benchmark."""

    timeout: float = 300.0
    """Seconds to wait for a server"""
    planner: str = "server"
    """server, in-process, name of an installed planner, or module:callable"""
    server: str | None = None
    """host:port (gRPC) or http://host:port; default: a server is started"""
    weights: tuple[Path, ...] = ()
    """Weights, in addition to the built-in weights"""
    model: str = ""
    """Weights to use: a name or a .safetensors file; empty: the default"""
    robot: str | None = None
    """Arm that executes the grasps with its own hand, in MuJoCo: name or .toml file"""
