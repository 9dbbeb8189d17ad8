"""Settings of the server: defaults, then EDGEGRASP_* environment variables, then arguments."""

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict, SettingsError

from edgegrasp_service.errors import InvalidSettings

MIB = 2**20


class Settings(BaseSettings):
    """What an operator can set; `EDGEGRASP_HTTP_PORT=8080` sets `http_port`."""

    model_config = SettingsConfigDict(env_prefix="EDGEGRASP_", extra="forbid", frozen=True)

    host: str = Field(default="127.0.0.1", description="address both transports bind to")
    http_port: int = Field(default=8000, ge=0, le=65535, description="0: any free port")
    grpc_port: int = Field(default=50051, ge=0, le=65535, description="0: any free port")
    backend: Literal["weights", "dummy"] = Field(
        default="weights", description="dummy: made-up grasps, for load tests without weights"
    )
    dummy_seconds: float = Field(
        default=0.0, ge=0.0, le=3600.0, description="service time of the dummy backend, seconds"
    )
    weights: tuple[Path, ...] = Field(
        default=(), description="weights files or folders of them, besides those that ship"
    )
    grippers: tuple[Path, ...] = Field(
        default=(), description="gripper files (.toml), named by their stem in requests"
    )
    default_model: str = Field(default="", description="weights used when a request names none")
    max_body_bytes: int = Field(
        default=32 * MIB, ge=1024, le=1024 * MIB, description="largest request body accepted"
    )
    max_points: int = Field(
        default=2_000_000, ge=1, description="most points in a cloud, before downsampling"
    )
    grace_seconds: float = Field(
        default=10.0, ge=0.0, description="time for requests in flight when stopping, seconds"
    )
    log_level: Literal["debug", "info", "warning", "error"] = "info"


def load_settings(**given: object) -> Settings:
    """Settings from defaults, the environment and arguments, the latter winning.

    Raises:
        InvalidSettings: A value is of the wrong type or out of range, or a name is unknown.
    """
    try:
        return Settings(**given)  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"])
        raise InvalidSettings(f"{name}: got {first['input']!r}. {first['msg']}.") from None
    except SettingsError as error:
        raise InvalidSettings(f"environment: {error}. Write lists as JSON.") from None
