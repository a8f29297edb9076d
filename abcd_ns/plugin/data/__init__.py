"""Reading scenes: models, photos and the frame they are put in."""
