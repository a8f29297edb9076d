"""`abcd`: what a user does with a scene, one folder or file a command."""
