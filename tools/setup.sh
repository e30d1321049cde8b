#!/bin/sh
# Make the virtual environment $1 with the locked versions, and find or install a libLLVM for Dr.Jit.
# Run by `make`, from the top of the checkout. Exits with code 2 and one line if the user has to act.
set -eu
venv=$1
say() { printf 'set-up: %s\n' "$*"; }
stop() { printf 'set-up: %s\n' "$*" >&2; exit 2; }
can_apt() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; }
apt_install() {
    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"
} >"$log" 2>&1
log=$(mktemp)
trap 'rm -f "$log"' EXIT

# Python: 3.11 or newer.
python=
for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
    if "$candidate" -c 'import sys; raise SystemExit(sys.version_info < (3, 11))' 2>/dev/null; then
        python=$candidate
        break
    fi
done
[ -n "$python" ] || stop "no Python 3.11 or newer found; install one (apt-get install python3 python3-venv), or: make PYTHON=/path/to/python3.11"

# libLLVM first: the check needs only Python, and without libLLVM no download is of use. The package
# itself needs another one (mgs/__init__.py), so its folder alone stands in for it.
find_llvm() {
    "$python" -c '
import sys, types
sys.modules["mgs"] = types.ModuleType("mgs")
sys.modules["mgs"].__path__ = ["mgs"]
from mgs.runtime import find_libllvm
print(find_libllvm())' 2>"$log"
}
if ! llvm=$(find_llvm); then
    reason=$(tail -n 1 "$log" | sed 's/^[A-Za-z.]*InputError: //')
    [ -z "${DRJIT_LIBLLVM_PATH:-}" ] && can_apt || stop "$reason"
    say "installing libllvm19 with apt-get"
    apt_install libllvm19 || { cat "$log" >&2; stop "apt-get could not install libllvm19; $reason"; }
    llvm=$(find_llvm) || stop "$(tail -n 1 "$log" | sed 's/^[A-Za-z.]*InputError: //')"
fi
say "libLLVM $llvm"

# The environment. Debian has ensurepip in a separate package.
if ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    say "$("$python" --version) into $venv"
    rm -rf "$venv"
    if ! "$python" -m venv "$venv" >"$log" 2>&1; then
        package="python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
        can_apt || stop "$python cannot make a virtual environment; install $package (apt-get install $package)"
        say "installing $package with apt-get"
        apt_install "$package" || { cat "$log" >&2; stop "apt-get could not install $package; install it yourself"; }
        "$python" -m venv --clear "$venv"
    fi
fi
say "installing $(grep -c == requirements.lock) packages, versions as in requirements.lock (a minute or two)"
[ -t 1 ] && quiet= || quiet=-qq
"$venv/bin/python" -m pip install $quiet --disable-pip-version-check --no-input -r requirements.lock
"$venv/bin/python" -m pip install -qq --disable-pip-version-check --no-input --no-deps --no-build-isolation -e .

# pymeshlab's wheel loads the system's libGL and libOpenGL, though it draws nothing here.
if ! "$venv/bin/python" -c 'import pymeshlab' 2>"$log"; then
    reason="pymeshlab does not load ($(tail -n 1 "$log")); install libGL (apt-get install libgl1 libopengl0)"
    can_apt || stop "$reason"
    say "installing libgl1 and libopengl0 with apt-get"
    apt_install libgl1 libopengl0 || { cat "$log" >&2; stop "$reason"; }
    "$venv/bin/python" -c 'import pymeshlab' 2>"$log" || stop "pymeshlab still does not load ($(tail -n 1 "$log"))"
fi
