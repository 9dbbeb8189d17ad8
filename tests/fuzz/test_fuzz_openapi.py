"""schemathesis: every request that the OpenAPI document allows, and many that it does not."""

import re
import sys
from pathlib import Path

import pytest
from hypothesis import settings
from tests.programs import run

SHORT = ("--phases", "fuzzing", "--max-examples", "5")
LONG = ("--phases", "coverage,fuzzing", "--max-examples", "100", "--max-time", "120")
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "unsupported_method",
)


def test_the_server_keeps_to_its_document(start_dummy, tmp_path: Path) -> None:
    program = Path(sys.executable).parent / "schemathesis"
    if not program.exists():
        pytest.skip("schemathesis is not installed")
    long = settings.get_current_profile_name() == "fuzz"
    token = "fuzz-0123456789abcdef0123456789abcdef"
    file = tmp_path / "tokens"
    file.write_text(token)
    flags = ("--log-level", "error", "--admin-token-file", str(file))
    with start_dummy(*flags) as server:
        command = [program, "run", f"{server.http_url}/openapi.json", "--no-color", "--seed", "1"]
        command += ["--header", f"Authorization: Bearer {token}"]
        # What the document allows may be shorter than any answer takes: a 504 is no fault.
        command += ["--header", "X-Request-Timeout: 60"]
        checks = ("--checks", ",".join(CHECKS))
        done = run(*command, *checks, *(LONG if long else SHORT), cwd=tmp_path)
        counted = re.search(r"(\d+) generated, (\d+) passed", done.stdout)
        assert counted, done.stdout[-5000:]
        assert int(counted[1]) == int(counted[2]) > 10
        assert server.stop() == 0
