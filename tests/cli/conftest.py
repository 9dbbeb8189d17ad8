"""Commands, as programs run them."""

from collections.abc import Callable
from functools import partial

import pytest
from typer.testing import CliRunner

from edgegrasp_cli.main import app


def invoke(code: int, *words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


@pytest.fixture(scope="session")
def run() -> Callable[..., str]:
    """Run a command that succeeds; gives what it prints."""
    return partial(invoke, 0)


@pytest.fixture(scope="session")
def refused() -> Callable[..., str]:
    """Run a command that ends with a message; gives the message."""
    return partial(invoke, 1)
