"""A server with the dummy detector, whose front does not import packages of detectors.

usage: python benchmarks/serve_dummy.py serve [FLAG ...]    `edgegrasp serve` without weights
"""

import runpy
import sys
from pathlib import Path


def main() -> None:
    """Run `edgegrasp` with the dummy detector; with settings as JSON, its fork server."""
    from edgegrasp_service.worker import fork_server, process

    if sys.argv[1].startswith("{"):
        dummy = runpy.run_path(str(Path(__file__).with_name("dummy.py")))
        fork_server.main(sys.argv[1], lambda settings: dummy["DummyCatalogue"]())
        return
    process.FORK_SERVER_COMMAND = (sys.executable, "-P", __file__)
    from edgegrasp_cli.main import main

    main()


if __name__ == "__main__":
    main()
