"""Command line: ``python -m experiments render`` and ``python -m experiments fit-bias``."""

import os
import sys

import equinox as eqx
import tyro

from .console import say_error
from .fit_bias_command import fit
from .render_command import render

_COMMANDS = {"render": render, "fit-bias": fit}


def main() -> int:
    """Run a command; errors are one line and exit code 2, an interrupt is 130."""
    try:
        tyro.extras.subcommand_cli_from_dict(_COMMANDS, prog="python -m experiments")
    except (ValueError, eqx.EquinoxRuntimeError) as error:
        say_error(str(error).strip().splitlines()[0])
        return 2
    except MemoryError:
        say_error("out of memory; choose a smaller image or shadow map")
        return 2
    except KeyboardInterrupt:
        say_error("interrupted; files written so far are whole")
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
