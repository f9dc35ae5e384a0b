"""`python -m sim RIG --serial`: the simulation without the other `era` commands."""

import os
import sys


def main() -> int:
    """Run the command line; returns the exit status."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")  # before numpy loads: more are slower
    from sim.early_exit import exit_on_signal

    with exit_on_signal():
        import typer

        from sim.cli import EXIT_STATUS, sim

        app = typer.Typer(pretty_exceptions_enable=False)
        app.command()(sim)
        try:
            app(prog_name="python -m sim")
        except tuple(EXIT_STATUS) as error:
            sys.stderr.write(f"sim: error: {error}\n")
            for kind, status in EXIT_STATUS.items():
                if isinstance(error, kind):
                    return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
