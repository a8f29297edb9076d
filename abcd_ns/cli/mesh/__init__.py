"""`abcd mesh`: the surface of a trained scene, from the depths that its training views see."""
