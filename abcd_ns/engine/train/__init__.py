"""Block coordinate descent: which block when, on which views, and for how long; its steps, growth and health.

`coordinator` is the whole of it, `planner` decides, `step` draws, `run_state` what it resumes from.
"""
