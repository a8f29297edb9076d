"""`abcd compare`: ABCD and its peers on one scene, under one protocol, each in its own process."""
