"""Settings of the server: defaults, then a TOML file, EDGEGRASP_* variables, and flags."""

import json
import os
import tomllib
from collections import ChainMap
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from edgegrasp_service.errors import InvalidSettings

MIB = 2**20
UNIX_PREFIX = "unix:"  # prefix of a host that is a folder of sockets
PREFIX = "EDGEGRASP_"
CONFIG_VARIABLE = PREFIX + "CONFIG"
CLIENT_PREFIX = PREFIX + "CLIENT_"  # of the client's commands
LIST_SETTINGS = ("weights", "grippers", "robots", "allowed_hosts")

Port = Annotated[int, Field(ge=0, le=65535)]
Count = Annotated[int, Field(ge=1)]
Size = Annotated[int, Field(ge=MIB)]  # bytes
Wait = Annotated[float, Field(ge=0.0, le=3600.0)]  # seconds
Timeout = Annotated[float, Field(gt=0.0, le=3600.0)]  # seconds


class Settings(BaseModel):
    """The server's settings; `EDGEGRASP_HTTP_PORT=8080` sets `http_port`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    host: str = "127.0.0.1"
    """address for HTTP and gRPC; unix:FOLDER: sockets http.sock and grpc.sock in a folder"""
    allowed_hosts: tuple[str, ...] = ()
    """names accepted in the Host header; *: any; none: any if tokens are set, else addresses and
    names without a dot"""
    http_port: Port = 8000
    """port for HTTP; 0: any free port"""
    grpc_port: Port = 50051
    """port for gRPC; 0: any free port"""
    weights: tuple[Path, ...] = ()
    """weights files or folders of them, in addition to the built-in weights"""
    grippers: tuple[Path, ...] = ()
    """gripper files (.toml); a gripper has the name of its file"""
    robots: tuple[Path, ...] = ()
    """robot files (.toml), or names of built-in robots; needs the extra robot"""
    default_model: str = ""
    """weights used when a request does not name any; none: edgegrasp-plus"""
    device: str = Field("cpu", pattern=r"^(auto|cpu|cuda(:\d+)?)$")
    """where networks run: cpu, cuda, cuda:N, or auto (the first GPU, else cpu)"""
    max_body_bytes: int = Field(32 * MIB, ge=1024, le=1024 * MIB)
    """largest request body accepted"""
    max_points: Count = 2_500_000
    """maximum number of points in a cloud, before downsampling"""
    max_voxels: Count = 200_000
    """maximum number of points in a cloud, after downsampling"""
    workers: int = Field(0, ge=0, le=1024)
    """worker processes; 0: one per core"""
    max_worker_bytes: int = Field(3 * 1024 * MIB, ge=64 * MIB)
    """memory that a worker may use for a request"""
    max_queue_length: int = Field(32, ge=0, le=65536)
    """maximum number of waiting requests, besides those being processed"""
    max_held_bytes: Size = 512 * MIB
    """maximum bytes of bodies and answers in memory"""
    max_streams: Count = Field(16, le=1024)
    """maximum number of open gRPC streams"""
    max_stream_requests: Count = Field(4, le=1024)
    """maximum number of unanswered requests read from a stream"""
    max_connections: Count = Field(512, le=65536)
    """maximum number of open connections, for HTTP and gRPC each"""
    max_request_seconds: float = Field(120.0, gt=0.0, le=86400.0)
    """longest processing time of a request, whatever its deadline"""
    read_seconds: Timeout = 10.0
    """time for a body to arrive, plus its size / min_bytes_per_second"""
    write_seconds: Timeout = 10.0
    """time for a client to take an answer, plus its size / min_bytes_per_second"""
    min_bytes_per_second: Count = 50_000
    """minimum transfer rate of bodies and answers"""
    record_folder: Path | None = None
    """folder for recorded requests and answers; none: nothing is recorded"""
    record_bytes: Size = 1024 * MIB
    """maximum bytes of recordings; the oldest are deleted"""
    outcomes_file: Path | None = None
    """file that /v1/outcomes appends to, up to 64 MiB; none: outcomes are refused"""
    max_header_bytes: int = Field(32768, ge=4096, le=MIB)
    """largest HTTP header or gRPC metadata accepted"""
    tls_certificate: Path | None = None
    """PEM file: the server's certificate chain"""
    tls_key: Path | None = None
    """PEM file: key of the certificate"""
    tls_client_ca: Path | None = None
    """PEM file: CAs for client certificates, which are then required"""
    token_file: Path | None = None
    """file with bearer tokens, one per line; a request must send one; none: no token is needed"""
    admin_token_file: Path | None = None
    """file of tokens, one per line, that also permit reloads; none: only SIGHUP reloads weights"""
    grace_seconds: Wait = 10.0
    """time for requests in progress to finish when stopping"""
    playground: bool = True
    """whether / shows the playground instead of /docs"""
    samples: Path | None = None
    """folder with samples.json: scenes that the playground offers to everyone"""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """minimum severity that is logged"""

    @model_validator(mode="after")
    def _check_tls(self) -> Self:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together. Give both or neither")
        if self.tls_client_ca is not None and self.tls_certificate is None:
            raise ValueError("tls_client_ca needs tls_certificate and tls_key")
        return self


def load_settings(config: Path | None = None, **given: object) -> Settings:
    """Settings from defaults, a TOML file, the environment and arguments, in rising priority.

    Without `config`, the file is the one named by EDGEGRASP_CONFIG, if set.

    Raises:
        InvalidSettings: A value is of the wrong type or out of range, or a name is unknown.
    """
    named = os.environ.get(CONFIG_VARIABLE)
    path = config or (Path(named) if named else None)
    sources = {"a flag": given, "the environment": _read_environment()}
    if path is not None:
        sources[str(path)] = _read_file(path)
    try:
        return Settings(**ChainMap(*sources.values()))
    except ValidationError as error:
        raise InvalidSettings(_sentence(error, sources)) from None


def _read_file(path: Path) -> dict[str, Any]:
    """The settings in a file; paths in it are relative to its folder."""
    if not path.is_file():
        raise InvalidSettings(f"config: got {str(path)!r}. There is no such file.")
    try:
        fields = tomllib.loads(path.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise InvalidSettings(f"config: {path}: {error}.") from None
    folder = path.absolute().parent
    for name, field in Settings.model_fields.items():
        value = fields.get(name)
        if "Path" in str(field.annotation) and isinstance(value, str):
            fields[name] = folder / value
        elif "Path" in str(field.annotation) and isinstance(value, list):
            fields[name] = [folder / part if isinstance(part, str) else part for part in value]
    return fields


def _read_environment() -> dict[str, Any]:
    """The settings in EDGEGRASP_* variables, including unknown names; lists are JSON."""
    fields: dict[str, Any] = {}
    for variable, text in os.environ.items():
        ours = variable.startswith(PREFIX) and not variable.startswith(CLIENT_PREFIX)
        if not text or not ours or variable == CONFIG_VARIABLE:
            continue
        name = variable.removeprefix(PREFIX).lower()
        try:
            fields[name] = json.loads(text) if name in LIST_SETTINGS else text
        except ValueError:
            raise InvalidSettings(f"{variable}: got {text!r}. Write lists as JSON.") from None
    return fields


def _sentence(error: ValidationError, sources: dict[str, dict[str, Any]]) -> str:
    """The first error, and where the value was set."""
    first = error.errors(include_url=False)[0]
    message = first["msg"].removeprefix("Value error, ")
    if not first["loc"]:
        return f"{message}."
    name = str(first["loc"][0])
    origin = next(source for source, fields in sources.items() if name in fields)
    if first["type"] == "extra_forbidden":
        name = "".join(letter if letter.isprintable() else "?" for letter in name)
        return f"{name}: no such setting. It comes from {origin}."
    path = ".".join(str(part) for part in first["loc"])
    return f"{path}: got {first['input']!r}. {message}. It comes from {origin}."
