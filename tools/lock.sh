#!/bin/sh
# Resolve the dependencies of pyproject.toml (with all extras, the groups dev and docs, and the build back end) and write
# requirements.lock. Python 3.11 is the lowest version supported, so the pins hold for all.
set -eu
venv=$(mktemp -d)
trap 'rm -rf "$venv"' EXIT
"${PYTHON:-python3.11}" -m venv "$venv"
"$venv/bin/pip" install -qq --upgrade pip
"$venv/bin/pip" install -qq --group dev --group docs '.[all]' hatchling
{
    echo "# Every package with its version, for tools/setup.sh. Written by \`make lock\`; edit pyproject.toml instead."
    "$venv/bin/pip" freeze --exclude mgs
} >requirements.lock
