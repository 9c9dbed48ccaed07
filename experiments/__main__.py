"""Command line: ``python -m experiments render`` and ``python -m experiments fit-bias``."""

import contextlib
import functools
import io
import os
import sys
from collections.abc import Callable, Sequence

from rich.text import Text

from .console import say_error

_PROGRAM = "python -m experiments"
_WITH_GRADIENTS = (
    "fit-bias",
    "fit-normal-map",
    "fit-light",
    "fit-pose",
    "fit-vertices",
    "derivatives",
)
_WITH_WORDS = ("--bias", "--filter", "--compare", "--shading", "--layout")


def main() -> int:
    """Run a command; errors are one line and exit code 2, an interrupt is 130.

    Code 3 says that no model meets the tolerance of ``simplest``.
    """
    try:
        return _run(sys.argv[1:])
    except KeyboardInterrupt:
        say_error("interrupted; files written so far are whole")
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _run(arguments: Sequence[str]) -> int:
    # Loaded here, so that an interrupt while they load, which takes seconds, ends well too.
    import jax

    from .baking.bake_command import bake
    from .baking.bake_light_command import bake as bake_light
    from .bias_fits.fit_bias_command import fit as fit_bias
    from .edge_fits.fit_light_command import fit as fit_light
    from .edge_fits.fit_pose_command import fit as fit_pose
    from .edge_fits.fit_vertices_command import fit as fit_vertices
    from .edge_gradients.derivatives_command import derive
    from .frontier.command import frontier
    from .memory import keep_freed_memory
    from .normal_map_fits.fit_normal_map_command import fit as fit_normal_map
    from .rendering.render_command import render
    from .simplest.command import simplest
    from .simplest.find import OutOfReach
    from .stability.command import stability

    if arguments and arguments[0] in _WITH_GRADIENTS:
        keep_freed_memory()
    commands = {
        "render": render,
        "fit-bias": fit_bias,
        "fit-normal-map": fit_normal_map,
        "fit-light": fit_light,
        "fit-pose": fit_pose,
        "fit-vertices": fit_vertices,
        "bake-normals": bake,
        "bake-light": bake_light,
        "frontier": frontier,
        "stability": stability,
        "simplest": simplest,
        "derivatives": derive,
    }
    try:
        _parse(arguments, commands)()
    except BrokenPipeError:
        raise
    except OutOfReach as error:
        say_error(str(error))
        return 3
    except (ValueError, OSError) as error:
        say_error(" ".join(str(error).split()))
        return 2
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        say_error("out of memory; choose a smaller image or map")
        return 2
    return 0


def _parse(
    arguments: Sequence[str], commands: dict[str, Callable[..., None]]
) -> Callable[[], None]:
    """Return what the arguments ask for, ready to run.

    Raises:
        ValueError: If they are not understood.
        SystemExit: After help was printed.
    """
    import tyro

    from .options import hint, join_options

    if arguments and not arguments[0].startswith("-") and arguments[0] not in commands:
        raise ValueError(f"no such command '{arguments[0]}'; {hint(arguments[0], commands)}")
    arguments = join_options(arguments, _WITH_WORDS)
    later = {name: _later(command) for name, command in commands.items()}
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.extras.subcommand_cli_from_dict(later, prog=_PROGRAM, args=arguments)
    except SystemExit as stop:
        if not stop.code:
            raise
    raise ValueError(f"{_reason(box.getvalue())}; see {_PROGRAM} --help")


def _later(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """Return a function with the command's options that binds them and does not run it."""

    @functools.wraps(command)
    def bind(*args: object, **options: object) -> Callable[[], None]:
        return functools.partial(command, *args, **options)

    return bind


def _reason(box: str) -> str:
    """Return the first part of tyro's box as one line, and the option it thinks was meant."""
    parts: list[list[str]] = [[]]
    for line in Text.from_ansi(box).plain.splitlines()[1:]:
        text = line.strip("│| ")
        if set(text) <= set("─-╰╯+"):
            parts.append([])
        else:
            parts[-1].append(text)
    first, *others = filter(None, parts)
    reason = " ".join(first).rstrip(".")
    for part in others:
        if part[0].startswith("Perhaps you meant"):
            reason += f"; perhaps you meant {part[1]}"
    return reason


if __name__ == "__main__":
    code = main()
    if code == 130:
        os._exit(code)  # XLA may be compiling still, and crashes if it is torn down then
    sys.exit(code)
