"""The README's table of speed, written from the results."""

from pathlib import Path
from typing import Any

BEGIN, END = "<!-- bench:begin -->", "<!-- bench:end -->"


def write_table(readme: Path, results: dict[str, Any]) -> None:
    """Put the table between the markers.

    Raises:
        ValueError: The file does not hold both markers.
    """
    text = readme.read_text()
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"{readme} holds no {BEGIN} … {END}")
    readme.write_text(f"{before}{BEGIN}\n{table(results)}\n{END}{after}")


def table(results: dict[str, Any]) -> str:
    """The table and what it was measured on."""
    rows = ["| | ours | textbook | times faster |", "| --- | --- | --- | --- |"]
    for name, paper in results["paper"].items():
        for variant, measured in paper["variants"].items():
            network = f"{name} in int8" if variant == "int8" else name
            for part, words in (("network", "network"), ("end_to_end", "cloud to ranked grasps")):
                seconds, faster = measured[part]["seconds"], measured[part]["times_faster"]
                rows.append(
                    f"| {network}, {words} | {seconds[variant]:.2f} s "
                    f"| {seconds['textbook']:.2f} s | {faster:.1f} |"
                )
    rows += ["", "| | scene | one thread | two threads |", "| --- | --- | --- | --- |"]
    for name, scenes in results["shipped"].items():
        for scene, of in scenes.items():
            one, two = 1000 * of["seconds_1"], 1000 * of["seconds_2"]
            rows.append(
                f"| `{name}`, cloud to ranked grasps | {scene} | {one:.0f} ms | {two:.0f} ms |"
            )
    machine, server = results["machine"], results["server"]
    labels = {kind: round(of["labels_per_second"]) for kind, of in results["simulator"].items()}
    return "\n".join(
        [
            *rows,
            "",
            f"Processor seconds on one thread of an {machine['processor']} with "
            f"{machine['capability']} ({machine['gflops']:.0f} GFLOP/s in float32), on two "
            f"threads seconds of the clock; medians of {measured['network']['rounds']} interleaved "
            f"runs, 32 approach points, at most 2,000 candidates. The first table: a cloud of two "
            f"views, {results['cloud_points']:,} points; the second: one view of each kind of "
            f"scene. "
            f"The server is ready after {server['ready_seconds']:.1f} s and takes "
            f"{server['rest_mb']:.0f} MB at rest, {server['peak_mb']:.0f} MB at most in ten "
            f"requests. The simulator labels {labels['packed']} grasps a second and core in packed "
            f"scenes, {labels['pile']} in piles.",
        ]
    )
