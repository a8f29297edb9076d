#!/usr/bin/env bash
# Write constraints.txt: every package `make setup` installs, for Python 3.10 to 3.12 on Linux, x86-64.
# Versions already in the file are kept where they still fit; `scripts/lock.sh --upgrade` takes the newest.
set -euo pipefail
cd "$(dirname "$0")/.."

.venv/bin/uv pip compile pyproject.toml --all-extras --universal --python-version 3.10 \
  --no-annotate --no-header --quiet --output-file constraints.txt "$@" >/dev/null
# [tool.uv] environments already says which platform this is for: repeating it 300 times helps nobody.
sed -i -E "s/ (and|;) (implementation_name != 'PyPy' and )?platform_machine == 'x86_64' and sys_platform == 'linux'//" \
  constraints.txt
sed -i '1i # The tested set: `make setup` installs exactly this. Written by `make constraints`; do not edit.' constraints.txt
