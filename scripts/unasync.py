"""Write the synchronous client from the asynchronous one.

usage: python scripts/unasync.py [--check]

--check writes nothing and fails if the file is out of date.
"""

import re
import subprocess
import sys
from pathlib import Path

CLIENT = Path(__file__).parents[1] / "clients" / "edgegrasp_client"
SOURCE, TARGET = CLIENT / "async_client.py", CLIENT / "client.py"

SUBSTITUTIONS = (
    (r'\A""".*"""', '"""The synchronous client, generated from async_client.py: edit that one."""'),
    (r"async_enumerate\(", "enumerate("),
    (r"AsyncIterable\[StreamRequest\] \| ", ""),
    (r"\bAwaitable\[(\w+)\]", r"\1"),
    (r"\bAsync([A-Z])", r"\1"),
    (r"\ban async ", "a "),
    (r"\b(async|await) ", ""),
    (r"\b__a(enter|exit)__", r"__\1__"),
    (r"\.(aclose\(|close\(None)", ".close("),
    (r"\bgrpc\.aio\b", "grpc"),
    (r"\basyncio\.sleep\b", "time.sleep"),
)


def synchronous(source: str) -> str:
    """The synchronous form of a module, without the imports it no longer needs."""
    for pattern, replacement in SUBSTITUTIONS:
        source = re.sub(pattern, replacement, source)
    for command in (["check", "--fix-only", "--select", "F401,F811,I"], ["format"]):
        ruff = [sys.executable, "-m", "ruff", *command, "--quiet", f"--stdin-filename={TARGET}"]
        done = subprocess.run(
            [*ruff, "-"], input=source, stdout=subprocess.PIPE, text=True, check=True
        )
        source = done.stdout
    return source


def main() -> None:
    made = synchronous(SOURCE.read_text())
    if sys.argv[1:] != ["--check"]:
        TARGET.write_text(made)
    elif made != TARGET.read_text():
        sys.exit(f"{TARGET.name} is out of date: run python scripts/unasync.py")


if __name__ == "__main__":
    main()
