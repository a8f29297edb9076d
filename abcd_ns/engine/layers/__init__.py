"""F and B: what is frozen before and behind a block, drawn once a visit and composited in each of its steps.

`footprints` says in which pixels, `compositing` has the algebra, `layer_renderer` draws, `layer_store` keeps,
`visit_layers` hands out.
"""
