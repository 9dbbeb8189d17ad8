"""Planners for clutter-removal trials, and how the command line finds them.

A planner of one's own needs nothing from here: see docs/benchmark.md.
"""

import importlib
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any

from edgegrasp_sim.trial import Planner

GROUP = "edgegrasp.planners"  # entry points under which packages may name their planners
SHIPPED = ("server", "in-process", "edge-sample", "oracle", "oracle-own")


@dataclass(frozen=True)
class NamedPlanner:
    """Makes the planner that a name stands for; can be sent to worker processes.

    A function is the planner itself; a class is called without arguments to make one.

    Attributes:
        name: `module:attribute`, or an entry point of the group `edgegrasp.planners`.
    """

    name: str

    def __call__(self) -> Planner:
        """The planner, in this process.

        Raises:
            ValueError: there is no such planner.
        """
        found = self._load()
        planner: Any = found() if isinstance(found, type) else found
        if not callable(planner):
            raise ValueError(f"planner {self.name!r} is no callable; name a function or a class")
        made: Planner = planner
        return made

    def _load(self) -> Any:
        installed = entry_points(group=GROUP)
        module, colon, attribute = self.name.partition(":")
        named = self.name in installed.names
        if not named and not (module and colon and attribute):
            known = [*SHIPPED, *sorted(installed.names)]
            raise ValueError(
                f"planner is {self.name!r}; choose one of {', '.join(known)}, or module:callable"
            )
        try:
            if named:
                return installed[self.name].load()
            return getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"planner {self.name!r} cannot be loaded: {error}") from error
