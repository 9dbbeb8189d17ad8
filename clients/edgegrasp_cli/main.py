"""The program `edgegrasp`: a table of commands, whose modules are imported when they run."""

import importlib
import io
import os
import sys
from typing import Annotated, Any

if sys.version_info < (3, 11):
    sys.exit("edgegrasp: the commands need Python 3.11 or newer; 3.10 runs the Python client only.")
try:
    import typer
    from typer.core import TyperCommand, TyperGroup
except ModuleNotFoundError:
    sys.exit("edgegrasp: the command line is not installed. pip install 'edgegrasp[cli]'")

# Command: its module after `edgegrasp_`, the extra it needs, one-line help. Its function has the
# command's name with underscores. `edgegrasp_lab` contains the laboratory's commands.
COMMANDS = {
    "serve": ("cli.serve", "service", "Answer requests over HTTP and gRPC."),
    "detect": ("cli.detect", "service,view", "Find grasps in a cloud or a depth image."),
    "view": ("cli.serve", "service", "Look at a scene and its grasps in the browser."),
    "models": ("cli.detect", "service", "List the available weights."),
    "robot": ("cli.robot", "robot,view", "Make a robot file from a URDF, and check one."),
    "mcp": ("cli.mcp", "mcp", "Serve grasps to language-model agents."),
    "open-inference": ("cli.open_inference", "open-inference", "Serve Open Inference clients."),
    "benchmark": ("lab.benchmark", "train", "Clear simulated clutter with a planner."),
    "benchmark-real": ("lab.benchmark_real", "service,view", "Judge grasps in real scenes."),
    "benchmark-tracking": ("lab.benchmark_tracking", "train,view", "Follow moving objects."),
    "compare": ("lab.benchmark", "train", "Compare two benchmarks scene by scene."),
    "replay": ("lab.replay", "service,sim", "Repeat a recorded attempt or request."),
    "generate-data": ("lab.train", "train", "Make labelled edge grasps in simulation."),
    "train": ("lab.train", "train", "Train weights on generated data."),
    "generate-scenes": ("lab.train", "meshes,open3d,robot,train", "Make images for train-scene."),
    "train-scene": ("lab.train", "open3d,train", "Train the network that recognises objects."),
    "import-checkpoint": ("lab.train", "model", "Convert the authors' checkpoints to safetensors."),
}


class LazyGroup(TyperGroup):
    """Shows commands from the table, and imports the one that is run."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[Any, Any, list[str]]:
        """Replace a table entry by the real command."""
        name, _, rest = super().resolve_command(ctx, args)
        return name, load_command(str(name)), rest

    def invoke(self, ctx: Any) -> Any:
        """Run a command; errors the user can fix end the program with their message."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            name = ctx.invoked_subcommand
            if isinstance(error, ModuleNotFoundError):
                sys.exit(_missing(name, error))
            if name is None or isinstance(error, BrokenPipeError):
                raise
            own = type(error).__module__.startswith("edgegrasp_")
            if own or isinstance(error, (ValueError, OSError)):
                sys.exit(f"edgegrasp {name}: {error}")
            raise


def load_command(name: str) -> Any:
    """Import a command; raises SystemExit if packages that it needs are not installed."""
    module, _, _ = COMMANDS[name]
    try:
        found = importlib.import_module(f"edgegrasp_{module}")
    except ModuleNotFoundError as error:
        sys.exit(_missing(name, error))
    program = getattr(found, name.replace("-", "_"))
    if not isinstance(program, typer.Typer):  # a single command, not a group of them
        function, program = program, typer.Typer(add_completion=False)
        program.command(name)(function)
    return typer.main.get_command(program)


def _missing(name: str, error: ModuleNotFoundError) -> str:
    _, extra, _ = COMMANDS[name]
    if error.name in ("PIL", "matplotlib"):  # pictures alone
        extra = "view"
    said = f"edgegrasp {name}: {error}"
    return said if "pip install" in said else f"{said}. pip install 'edgegrasp[{extra}]'"


app = typer.Typer(
    cls=LazyGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="edgegrasp view    edgegrasp detect cloud.ply --picture grasps.png    "
    "edgegrasp COMMAND -h",
)
for _name, (_, _, _text) in COMMANDS.items():
    app.command(_name, help=_text, cls=TyperCommand)(lambda: None)


@app.callback(invoke_without_command=True)
def _common(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version, and stop.")
    ] = False,
) -> None:
    """Grasp detection as a service: point clouds in, scored 6-DoF grasps out."""
    if version:
        from importlib.metadata import version as version_of

        print(f"edgegrasp {version_of('edgegrasp')}")
        raise typer.Exit


def main() -> None:
    """Run the program; a full disk ends it with a message, a closed pipe without one."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal may lack some characters
    try:
        try:
            app()
        finally:
            if sys.stdout is not None:  # None: it was closed when the program started
                sys.stdout.flush()  # at exit, Python would print a traceback
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        quiet = isinstance(error, BrokenPipeError)
        sys.exit(1 if quiet else f"edgegrasp: standard output: {error}")
