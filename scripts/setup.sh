#!/usr/bin/env bash
# Make .venv and install the pinned set (constraints.txt) and this package into it. `make setup` calls it when
# that set changed; calling it again is always safe. PYTHON=... chooses the interpreter of a new .venv.
set -euo pipefail
cd "$(dirname "$0")/.."

readonly VENV=.venv
readonly VENV_PYTHON=$VENV/bin/python
# Present only while packages are being installed: half a package can look like a whole one.
readonly UNFINISHED=$VENV/.unfinished
readonly SUPPORTED='import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))'

say() { printf 'setup: %s\n' "$*" >&2; }
die() {
  say "error: $*"
  exit 1
}

find_python() {
  local candidate without_venv=
  for candidate in ${PYTHON:-python3.11 python3.12 python3.10 python3 python}; do
    # A pyenv shim exists for versions it will not start, so ask the interpreter itself.
    "$candidate" -c "$SUPPORTED" 2>/dev/null || continue
    if "$candidate" -c 'import venv, ensurepip' 2>/dev/null; then
      echo "$candidate"
      return
    fi
    without_venv=${without_venv:-$candidate}
  done
  if [[ -n $without_venv ]]; then
    die "$without_venv has no venv module; on Debian or Ubuntu: sudo apt-get install $(basename "$without_venv")-venv"
  fi
  [[ -z ${PYTHON:-} ]] || die "PYTHON=$PYTHON is no Python 3.10, 3.11 or 3.12"
  die "no Python 3.10, 3.11 or 3.12 found; install one, or name it: make setup PYTHON=/path/to/python3.11"
}

venv_works() {
  [[ ! -e $UNFINISHED ]] &&
    "$VENV_PYTHON" -c "$SUPPORTED" 2>/dev/null &&
    { "$VENV_PYTHON" -m pip --version || "$VENV_PYTHON" -m ensurepip; } >/dev/null 2>&1
}

make_venv() {
  venv_works && return
  local python
  python=$(find_python)
  [[ ! -e $VENV ]] || say "$VENV is incomplete (an interrupted set-up?): making it anew"
  rm -rf "$VENV"
  say "making $VENV with $("$python" --version 2>&1)"
  "$python" -m venv "$VENV"
}

# The packages to install, in the form `-r` takes. Only pyliblzfse (nerfstudio's record3d reader) has to be
# compiled; where that cannot work the rest still can.
list_packages() {
  local has_headers='import os, sysconfig, sys
sys.exit(not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")))'
  if command -v "${CC:-cc}" >/dev/null && "$VENV_PYTHON" -c "$has_headers"; then
    cat constraints.txt
  else
    say "no C compiler or no Python.h (apt-get install build-essential python3-dev): leaving out pyliblzfse, so no record3d data"
    grep -v '^pyliblzfse==' constraints.txt
  fi
}

install_with_uv() {
  # uv knows nothing of pip's settings; a mirror set there should serve here too.
  local index quiet=
  index=${PIP_INDEX_URL:-$("$VENV_PYTHON" -m pip config get global.index-url 2>/dev/null || true)}
  [[ -z $index ]] || export UV_DEFAULT_INDEX="${UV_DEFAULT_INDEX:-$index}"
  export UV_HTTP_TIMEOUT="${UV_HTTP_TIMEOUT:-300}"
  [[ -t 2 ]] || quiet=--quiet # the progress bars are for people

  "$VENV_PYTHON" -m pip install --quiet --disable-pip-version-check -c constraints.txt uv &&
    "$VENV/bin/uv" pip install $quiet --python "$VENV_PYTHON" --no-deps -r "$1" -e .
}

install_packages() {
  local packages
  packages=$(mktemp)
  # shellcheck disable=SC2064  # the name is wanted now: the variable is local
  trap "rm -f '$packages'" EXIT
  list_packages >"$packages"
  say "installing the pinned packages: about 3 GB to download the first time, 7 GB on disk"
  touch "$UNFINISHED"
  # --no-deps: the list is complete, so nothing unpinned can slip in.
  install_with_uv "$packages" || {
    say "uv could not do it; trying pip, which is slower"
    "$VENV_PYTHON" -m pip install --disable-pip-version-check --no-deps -r "$packages" -e . ||
      die "the packages could not be installed; the reason stands above. Run it again to go on: downloads are kept"
  }
  rm -f "$UNFINISHED"
}

# open3d (ns-export imports it) links system libraries that a server may lack. libusb comes in a wheel, and a
# link beside open3d's own library is where the loader looks first; the others need apt-get.
check_open3d() {
  local folder library reason
  folder=$("$VENV_PYTHON" -c 'import importlib.util as u; print(*u.find_spec("open3d").submodule_search_locations)')
  library=$("$VENV_PYTHON" -c 'import libusb_package as p; print(p.get_library_path())')
  if ! "$VENV_PYTHON" -c 'import ctypes; ctypes.CDLL("libusb-1.0.so.0")' 2>/dev/null; then
    ln -sf "$library" "$folder/libusb-1.0.so.0"
  fi
  reason=$("$VENV_PYTHON" -c 'import open3d' 2>&1 | tail -n 1) || true
  if [[ $reason == *"cannot open shared object file"* ]]; then
    say "note: ns-export will not start (${reason#*Error: }); sudo apt-get install libgl1 libegl1 libgomp1 libusb-1.0-0 libx11-6"
  fi
}

# The CPU rasterizer, for this processor; without a compiler it stays slow and says so itself.
compile_library() {
  say "compiling the CPU rasterizer: some 15 seconds, once per machine"
  "$VENV_PYTHON" -c 'from abcd_ns.engine.kernels.native import library; library()'
}

[[ $(uname -sm) == "Linux x86_64" ]] ||
  die "the pinned set is for Linux on x86-64; here, install into an environment of your own: pip install -e '.[dev]'"
make_venv
install_packages
check_open3d
compile_library
say "done: $VENV is ready"
