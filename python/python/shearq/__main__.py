"""The command line: ``python -m shearq`` and the script ``shearq`` are the same as the binary."""

import os
import signal
import sys

from ._shearq import run_command

# ceci starts `python3 -m shearq STAGE` for the stages of a package.
_STAGES = ("ShearBias", "ShearMeasure")


def main() -> int:
    """Run the command line with the arguments of this process and return its exit code."""
    if sys.argv[1:2] and sys.argv[1] in _STAGES:
        from .ceci import PipelineStage

        return int(PipelineStage.main())
    # Python would only note an interrupt, and act on it when the command is done.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Of models of Piff, which this interpreter draws.
    os.environ.setdefault("SHEARQ_PYTHON", sys.executable)
    return run_command(["shearq", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
