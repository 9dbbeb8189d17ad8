"""Repeat any attempt that a benchmark recorded, in the scene and view it was made in."""

from pathlib import Path
from typing import Self

from edgegrasp_sim.camera import Observation
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.protocol import protocol_from
from edgegrasp_sim.results import ResultFolder
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import Attempt, PlannedGrasp, Round, RoundDriver


class Replay:
    """The recorded rounds of a result folder, to be repeated.

    Raises:
        FileNotFoundError: the folder contains no benchmark, or its objects are not there.
        ValueError: the objects are not those of the benchmark.
    """

    def __init__(self, folder: ResultFolder, objects: Path | None = None) -> None:
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
        if models.digest != run["objects"]["digest"]:
            raise ValueError(
                f"the objects in {objects} are not those of the benchmark in {folder.path}; "
                "pass the folder it was run with"
            )
        self.rounds = {(done.seed, done.index): done for done in folder.rounds()}
        self.simulation = ClutterSimulation(
            {self.scene: models}, engine=run["engine"], gripper=run.get("gripper")
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.simulation.close()

    def find(self, seed: int, index: int, attempt: int = 0) -> Round:
        """A recorded round that has an attempt of this number; ValueError: there is none."""
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

    def repeat(self, seed: int, index: int, attempt: int) -> tuple[Attempt, Observation]:
        """Repeat a round up to and including an attempt.

        Returns:
            The attempt when repeated, and the image before it.

        Raises:
            ValueError: there is no such attempt.
        """
        done = self.find(seed, index, attempt)
        driver = RoundDriver(self.simulation, self.scene, self.protocol, seed=seed, index=index)
        for recorded in done.attempts[: attempt + 1]:
            seen = driver.look()
            while driver.view < recorded.view:  # views in which no grasp was found
                seen = driver.look()
            grasp = PlannedGrasp(recorded.T_world_hand, recorded.score, recorded.width)
            repeated = driver.execute(grasp)
        return repeated, seen
