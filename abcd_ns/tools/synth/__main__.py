"""`python -m abcd_ns.tools.synth OUT`: the same as `abcd synth OUT`."""

import sys

from abcd_ns.tools.cli import main

if __name__ == "__main__":
    sys.exit(main(["synth", *sys.argv[1:]]))
