"""Settings as text: `edgegrasp serve --print-config`."""

import json

from edgegrasp_service.settings import SECRETS, Origins, Settings, one_line


def config_text(settings: Settings, origins: Origins) -> str:
    """Settings as a TOML file that gives the same ones, secrets left out."""
    lines = ["# EdgeGrasp settings in effect, and where each comes from; secrets are left out."]
    for name in Settings.model_fields:
        value = getattr(settings, name)
        if name in SECRETS:
            lines.append(f"# {name}: {len(value) or 'none'}{', hidden' * bool(value)}")
        elif value is None:
            lines.append(f"# {name}: none")
        else:
            lines.append(f"{name} = {_toml(value)}")
        lines[-1] += f"  # {one_line(origins[name])}"
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(part) for part in value)}]"
    if isinstance(value, int | float):
        return repr(value)
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
