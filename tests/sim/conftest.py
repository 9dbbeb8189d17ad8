from collections.abc import Iterator

import pytest

from edgegrasp_sim.engine import ENGINES, World, choose_engine, make_world
from edgegrasp_sim.simulation import ClutterSimulation


@pytest.fixture(scope="session", params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    """Each engine that is installed."""
    try:
        return choose_engine(request.param)
    except ModuleNotFoundError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def simulation(engine: str) -> Iterator[ClutterSimulation]:
    """A simulation that all tests share."""
    with ClutterSimulation(engine=engine) as simulation:
        yield simulation


@pytest.fixture
def world(engine: str) -> Iterator[World]:
    with make_world(engine) as world:
        yield world
