"""What is found of each photo beside the scene, and belongs to the run: its light, and its pose."""
