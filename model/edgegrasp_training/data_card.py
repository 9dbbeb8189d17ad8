"""The data card: what a folder of labelled views holds."""

from collections import Counter
from pathlib import Path

from edgegrasp_training.views import LabelledView, load_view, scene_of

CARD_FILE = "card.md"


def write_data_card(folder: Path, paths: list[Path], command: str) -> Path:
    """Count views, scenes, labels and objects, for each kind of scene, into `card.md`.

    Args:
        folder: Gets the card.
        paths: View files.
        command: That made them.
    """
    views = {path: load_view(path) for path in paths}
    kinds = sorted({_kind(path) for path in paths})
    columns = [_facts({p: v for p, v in views.items() if _kind(p) == kind}) for kind in kinds]
    columns.append(_facts(views))
    names = [*kinds, "all"]
    rule = "| --- " * (len(names) + 1) + "|"
    lines = ["# Labelled views", "", f"| | {' | '.join(names)} |", rule]
    lines += [
        f"| {fact} | {' | '.join(column[fact] for column in columns)} |" for fact in columns[0]
    ]
    objects = Counter(
        known
        for view in views.values()
        for known in set(zip(view.objects, view.object_digests, strict=True))
    )
    lines += ["", "Made by:", "", "```", command, "```", ""]
    lines += ["Objects, the SHA-256 of their files, and in how many views they are:", ""]
    lines += [f"- {name} `{digest}`: {count}" for (name, digest), count in sorted(objects.items())]
    path = folder / CARD_FILE
    path.write_text("\n".join(lines) + "\n")
    return path


def _kind(path: Path) -> str:
    return path.stem.split("_")[0]


def _facts(views: dict[Path, LabelledView]) -> dict[str, str]:
    """The rows of one column."""
    tried = sum(len(view.tried()) for view in views.values())
    held = sum(int((view.success == 1).sum()) for view in views.values())
    shaken = [view for view in views.values() if view.firm is not None]
    shaken_held = sum(int((view.success == 1).sum()) for view in shaken)
    firm = sum(int((view.firm == 1).sum()) for view in shaken if view.firm is not None)
    return {
        "scenes": str(len({scene_of(path) for path in views})),
        "views": str(len(views)),
        "grasps tried": str(tried),
        "held after the lift": _share(held, tried),
        "of those, held after shaking too": _share(firm, shaken_held),
        "objects": str(len({name for view in views.values() for name in view.objects})),
    }


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "-"
