"""A procedural scene of walled courts, drawn by an independent ray caster into a COLMAP data set."""

from abcd_ns.lab.synth.command import SynthError, synth

__all__ = ["SynthError", "synth"]
