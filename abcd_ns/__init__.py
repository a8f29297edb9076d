"""ABCD: Alpha-Composited Block Coordinate Descent for Gaussian Splatting, as a Nerfstudio method."""

__version__ = "0.1.0"
