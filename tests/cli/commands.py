"""Commands, as programs run them."""

from functools import partial

from typer.testing import CliRunner

from edgegrasp_cli.main import app


def invoke(code: int, *words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output
    return result.output


run = partial(invoke, 0)  # a command that succeeds; gives what it prints
refused = partial(invoke, 1)  # a command that ends with a message; gives the message
