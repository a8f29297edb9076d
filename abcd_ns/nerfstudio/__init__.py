"""ABCD as a method of nerfstudio's: dataparser, datamanager, model, pipeline, trainer and their configs."""
