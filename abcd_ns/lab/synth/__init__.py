"""A procedural scene of walled courts, drawn by an independent ray caster into a COLMAP data set."""
