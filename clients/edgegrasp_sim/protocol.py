"""Protocols: the constants of a benchmark, other than planner and objects.

A protocol is a named and versioned file in `protocols/`; its constants go into every result.
"""

import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, NonNegativeFloat, PositiveInt, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from edgegrasp_sim.camera import Sizes, TableView, ViewRange
from edgegrasp_sim.fixed_parts import OPEN_THICKNESS
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.sensor import SENSORS, DepthNoise, DepthSensor, Share, random_sensor

FOLDER = Path(__file__).parent / "protocols"
STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, config=STRICT)
class SceneRules:
    """The objects on the table."""

    # How many objects to try to place, in turn from round to round.
    num_objects: Annotated[tuple[PositiveInt, ...], Field(min_length=1)]
    packed_scale: Sizes  # range of the scale of objects in packed scenes, on tables and shelves
    pile_scale: Sizes  # range of the scale of objects in piles and bins
    table_thickness: NonNegativeFloat = OPEN_THICKNESS  # of packed and pile scenes, metres


@dataclass(frozen=True, config=STRICT)
class RoundRules:
    """The criterion for a held object, and conditions that end a round."""

    min_opening: NonNegativeFloat  # metres between the fingers; below this a hand holds nothing
    max_consecutive_failures: PositiveInt  # failed grasps in a row that end a round
    max_no_grasp: PositiveInt  # views without any grasp that end a round


@dataclass(frozen=True, config=STRICT)
class CameraRules(ViewRange):
    """The camera's position, drawn uniformly from these ranges before every grasp."""

    views: PositiveInt  # images before every grasp, spread evenly over a full turn from the first


@dataclass(frozen=True, config=STRICT)
class NoiseRules(DepthNoise):
    """Noise of the depth image, see `DepthNoise`, and of the points made from it."""

    # Standard deviation of each coordinate of each point, metres.
    point_std: NonNegativeFloat = 0.0
    # Kind of camera whose faults the images also have; `random`: a new camera before every grasp.
    sensor: Literal["", "random", "structured-light", "stereo", "time-of-flight"] = ""

    def faults(self, rng: np.random.Generator) -> list[DepthNoise | DepthSensor]:
        """This noise, and the faults of the next view's camera, if any."""
        sensor = random_sensor(rng) if self.sensor == "random" else SENSORS.get(self.sensor)
        return [self] if sensor is None else [self, sensor]


@dataclass(frozen=True, config=STRICT)
class PlanningRules:
    """The input of a planner, and its number of candidates."""

    # `known`: the cloud is cropped above the table, and its plane is given; `seen`: the cloud
    # includes the table, and its plane is given, so that the depth scale can be corrected;
    # `around`: the cloud contains all that the camera sees, and plane and workspace are given;
    # `auto`: the same cloud, and only the camera's position is given.
    table: TableView
    num_approach_points: PositiveInt  # approach points sampled
    num_candidates: PositiveInt  # candidates scored at most
    min_score: Share  # grasps with a lower score are not executed
    # Greatest relative error of depths, which a planner corrects by the known table.
    max_depth_error: Share = 0.0


@dataclass(frozen=True, config=STRICT)
class Protocol:
    """A named and versioned way to run the benchmark."""

    name: str  # of the protocol
    version: PositiveInt  # raised whenever a constant changes
    source: str  # where its constants come from
    rounds: PositiveInt  # number of rounds for each seed of a full run
    seeds: tuple[int, ...]  # of a full run
    scene: SceneRules  # the objects
    round: RoundRules  # held objects and the end of a round
    camera: CameraRules  # the camera's position
    noise: NoiseRules  # of the camera
    planning: PlanningRules  # the input of a planner
    engine: str = ""  # the physics engine for its figures; empty: any
    kind: SceneKind | None = None  # kind of its scenes; None: packed and pile

    def to_json(self) -> dict[str, Any]:
        """All constants except engine and kind, which a result names separately; for JSON."""
        table = asdict(self)
        del table["engine"], table["kind"]
        for section, name in (("noise", "sensor"), ("planning", "max_depth_error")):
            if not table[section][name]:  # so that earlier results can be resumed
                del table[section][name]
        return table


def load_protocol(name: str) -> Protocol:
    """A built-in protocol by name, or a `.toml` file; raises FileNotFoundError or ValueError."""
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(protocol_names())
        raise FileNotFoundError(f"no protocol {name!r}; choose one of {known}, or a .toml file")
    try:
        return protocol_from(_constants(path))
    except ValidationError as error:
        wrong = (f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors())
        raise ValueError(f"protocol {name}: {'; '.join(wrong)}") from None
    except ValueError as error:
        raise ValueError(f"protocol {name}: {error}") from error


def _constants(path: Path) -> dict[str, Any]:
    """The tables of a file, completed with constants of its `base`, a built-in protocol."""
    table = tomllib.loads(path.read_text("utf-8"))
    if "base" not in table:
        return table
    base = table.pop("base")
    if base not in protocol_names():
        raise ValueError(f"base is {base!r}; name one of {', '.join(protocol_names())}")
    inherited = _constants(FOLDER / f"{base}.toml")
    for name, value in table.items():
        both = isinstance(value, dict) and isinstance(inherited.get(name), dict)
        inherited[name] = inherited[name] | value if both else value
    return inherited


def protocol_names() -> list[str]:
    """The names of the built-in protocols, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def protocol_from(table: dict[str, Any]) -> Protocol:
    """Build a protocol from the tables of TOML or a manifest; raises ValueError."""
    return TypeAdapter(Protocol).validate_python(table)
