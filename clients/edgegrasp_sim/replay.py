"""Repeat what a benchmark recorded: any attempt, in the scene and view it was made in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from edgegrasp_sim.benchmark import objects_digest
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.protocol import protocol_from
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trials import PlannedGrasp, RoundDriver
from edgegrasp_sim.window import Window

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from edgegrasp_sim.observation import Observation
    from edgegrasp_sim.results import ResultFolder
    from edgegrasp_sim.trials import Attempt, Round


class Replay:
    """The rounds of a result folder, to be gone through again.

    Args:
        folder: a benchmark's.
        objects: where its object folder is now; by default where it was.
        gui: show PyBullet's window.

    Raises:
        FileNotFoundError: the folder holds no benchmark, or its objects are not there.
        ValueError: the objects are not those of the benchmark.
    """

    def __init__(
        self, folder: ResultFolder, objects: Path | None = None, *, gui: bool = False
    ) -> None:
        facts = folder.manifest()
        run = facts["run"]
        self.scene = SceneKind(run["scene"])
        self.protocol = protocol_from(run["protocol"])
        if objects is None and facts["objects_folder"] is not None:
            objects = Path(facts["objects_folder"])
        models = (
            ObjectSet.builtin(self.scene)
            if objects is None
            else ObjectSet.from_folder(objects, self.scene, facts["split"])
        )
        if objects_digest(models) != run["objects"]["digest"]:
            raise ValueError(
                f"the objects in {objects} are not those of the benchmark in {folder.path}; "
                "pass the folder it was run with"
            )
        self.rounds = {(done.seed, done.index): done for done in folder.rounds()}
        self.simulation = ClutterSimulation({self.scene: models}, gui=gui)
        if gui:
            Window(self.simulation.world)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.simulation.close()

    def find(self, seed: int, index: int, attempt: int = 0) -> Round:
        """A recorded round that has an attempt of this number.

        Raises:
            ValueError: there is none.
        """
        done = self.rounds.get((seed, index))
        if done is None:
            known = ", ".join(f"{s}/{i}" for s, i in list(self.rounds)[:10])
            raise ValueError(f"round is {index} of seed {seed}; the folder has {known}, …")
        if not 0 <= attempt < len(done.attempts):
            raise ValueError(
                f"attempt is {attempt}; round {index} of seed {seed} has {len(done.attempts)}, "
                "counted from 0"
            )
        return done

    def start(self, done: Round) -> RoundDriver:
        """The round's scene, before its first view."""
        return RoundDriver(
            self.simulation, self.scene, self.protocol, seed=done.seed, index=done.index
        )

    def advance(
        self, driver: RoundDriver, done: Round, attempt: int, executed: int = 0
    ) -> Observation:
        """Go on to the view of an attempt, repeating the attempts before it.

        Args:
            driver: of the round.
            done: the recorded round.
            attempt: its attempt to stop before.
            executed: how many attempts `driver` has made already.

        Returns:
            What was seen when the attempt was planned.
        """
        for number in range(executed, attempt):
            self._look(driver, done.attempts[number].view)
            driver.execute(recorded_grasp(done.attempts[number]))
        return self._look(driver, done.attempts[attempt].view)

    def repeat(self, seed: int, index: int, attempt: int) -> tuple[Attempt, Observation]:
        """Make an attempt again.

        Returns:
            What came of it now, and what was seen before it.

        Raises:
            ValueError: there is no such attempt.
        """
        done = self.find(seed, index, attempt)
        driver = self.start(done)
        seen = self.advance(driver, done, attempt)
        return driver.execute(recorded_grasp(done.attempts[attempt])), seen

    def _look(self, driver: RoundDriver, view: int) -> Observation:
        while True:  # views without a grasp lie between those with one
            seen = driver.look()
            if driver.view >= view:
                return seen


def recorded_grasp(attempt: Attempt) -> PlannedGrasp:
    """The grasp of a recorded attempt."""
    return PlannedGrasp(attempt.T_world_hand, attempt.score, attempt.width)
