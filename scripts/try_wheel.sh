#!/usr/bin/env bash
# Build dist/, look what is in it, and try the wheel as users meet it: beside a stock nerfstudio, in an environment of
# its own. Downloads what `make setup` does where that is not cached.
#
#   scripts/try_wheel.sh FOLDER      FOLDER/venv is made; PYTHON=... chooses its interpreter
set -euo pipefail
cd "$(dirname "$0")/.."
repository=$PWD
folder=$(mkdir -p "${1:?name a folder}" && cd "$1" && pwd)
venv=$folder/venv

say() { printf '\ntry_wheel: %s\n' "$*" >&2; }
holds() {
  local listing=$1
  shift
  for file; do grep -q "$file" <<<"$listing" || { say "error: $file is missing"; exit 1; }; done
}

"${PYTHON:-python3}" -m venv --clear "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check -c constraints.txt uv
# uv does not read pip's settings.
index=${PIP_INDEX_URL:-$("$venv/bin/python" -m pip config get global.index-url 2>/dev/null || true)}
[[ -z $index ]] || export UV_DEFAULT_INDEX="${UV_DEFAULT_INDEX:-$index}"

say "building"
rm -rf dist
"$venv/bin/uv" build --quiet --out-dir dist
wheel=$(echo "$repository"/dist/*.whl)
holds "$("$venv/bin/python" -m zipfile -l "$wheel")" \
  abcd_ns/py.typed abcd_ns/configs/small-gpu.toml abcd_ns/cli/report/page.html abcd_ns/methods.py licenses/LICENSE
holds "$(tar tzf dist/*.tar.gz)" /abcd_ns/py.typed /tests/test_package.py /docs/tutorial.md /constraints.txt /CITATION.cff
ls -sh dist

# Elsewhere, so that neither this checkout's code nor its settings for uv are found.
cd "$folder"
export PATH="$venv/bin:$PATH"
unset PYTHONPATH
say "installing nerfstudio 1.1.5"
uv pip install --quiet --python "$venv/bin/python" -c "$repository/constraints.txt" nerfstudio==1.1.5
says() { # WORD COMMAND...: the command ends well and prints the word
  local word=$1 printed
  shift
  say "\$ $*"
  printed=$("$@" 2>&1) || { printf '%s\n' "$printed"; say "error: exit code above 0"; exit 1; }
  grep -q -e "$word" <<<"$printed" || { printf '%s\n' "$printed"; say "error: nothing about $word"; exit 1; }
  grep -m 1 -e "$word" <<<"$printed"
}
says max-num-iterations ns-train splatfacto --help
say "installing the wheel"
uv pip install --quiet --python "$venv/bin/python" -c "$repository/constraints.txt" "$wheel"
says max-num-iterations ns-train splatfacto --help
says pipeline.device-budget-gb ns-train abcd --help
says "Training can work here" abcd doctor
python -c 'from abcd_ns.cli.train import command_line as line; from pathlib import Path; print(*line(Path("small-gpu")))'
say "all is well: $wheel"
