#!/bin/sh
# Writes requirements.lock: every package of pyproject.toml and its dev group, pinned and hashed for all platforms.
# Keeps the versions of the present lock where they still fit; options are uv's: tools/lock.sh --upgrade-package jax
set -eu
case $0 in */*) cd "${0%/*}/.." ;; *) cd .. ;; esac

# uv makes the lock and nothing else here needs it, so it lives only as long as this script.
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python=$(sh tools/setup.sh --find-python)
"$python" -m venv "$scratch"
"$scratch/bin/python" -m pip install --quiet --disable-pip-version-check 'uv>=0.9.8'

"$scratch/bin/uv" pip compile pyproject.toml --group dev --output-file requirements.lock --quiet \
    --universal --python "$python" --generate-hashes --no-emit-index-url --no-emit-find-links \
    --custom-compile-command 'make lock' "$@"
