"""Programs that tests run to their end."""

import subprocess
import sys
from typing import Any

EDGEGRASP = (sys.executable, "-c", "from edgegrasp_cli.main import main; main()")


def run(*words: object, code: int = 0, **more: Any) -> subprocess.CompletedProcess[str]:
    """What a program says; its exit status has to be `code`."""
    command = [str(word) for word in words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, **more)
    assert done.returncode == code, done.stdout[-5000:] + done.stderr
    return done
