"""`python -m abcd_ns.tools.synth OUT`: the same as `abcd synth OUT`."""

import sys

import tyro

from abcd_ns.tools.synth.command import SynthError, synth

if __name__ == "__main__":
    try:
        tyro.cli(synth, prog="python -m abcd_ns.tools.synth")
    except SynthError as error:
        sys.exit(f"error: {error}")
