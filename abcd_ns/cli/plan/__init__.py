"""`abcd plan`: `forecast` reads photos and times a step, `command` loads that where options are right."""
