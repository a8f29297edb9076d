"""The one procedural world: exact surfaces, and the pictures that cameras take of them, without Gaussians."""
