#!/bin/sh
# Resolve the dependencies of pyproject.toml anew, with its extra view, its groups dev and docs, and the build back end; write
# requirements.lock.
# Python 3.11: the lowest version supported, so that the pins hold for all.
set -eu
venv=$(mktemp -d)
trap 'rm -rf "$venv"' EXIT
"${PYTHON:-python3.11}" -m venv "$venv"
"$venv/bin/pip" install -qq --upgrade pip
"$venv/bin/pip" install -qq --group dev --group docs '.[view]' hatchling
{
    echo "# Every package with its version, for tools/setup.sh. Written by \`make lock\`; edit pyproject.toml instead."
    "$venv/bin/pip" freeze --exclude mgs
} >requirements.lock
