"""A run as its user meets it: progress, settings, log, how it stops and how it resumes."""

from abcd_ns.run import STATE as STATE
from abcd_ns.run import STORE as STORE
