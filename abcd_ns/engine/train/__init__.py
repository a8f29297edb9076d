"""Block coordinate descent: which block when, on which views, and for how long; its steps, growth and health.

`coordinator` is the whole of it, `planner` decides, `visit_training` draws, `run_state` what it resumes from.
"""
