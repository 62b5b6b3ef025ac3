#!/bin/sh
# Creates .venv beside this folder with exactly the packages of requirements.lock and the project itself (editable).
# Says nothing and does nothing when that is already so. Installs nothing outside .venv.
#
#   tools/setup.sh                 set up
#   tools/setup.sh --find-python   print the Python that would be used
#
# PYTHON names a Python to try first; SETUP_SEARCH is a colon-separated list of folders to look into beyond PATH.
# POSIX sh, because a machine's python3 may be missing or too old to run anything of ours.
set -eu
case $0 in */*) cd "${0%/*}/.." ;; *) cd .. ;; esac

say() { printf '%s\n' "$*" >&2; }

# ---- find a Python -------------------------------------------------------------------------------------------------

search=${SETUP_SEARCH-"${PYENV_ROOT:-${HOME:-}/.pyenv}/versions/*/bin:${HOME:-}/.local/bin:/usr/local/bin:/usr/bin\
:/opt/*/bin:/opt/python/*/bin:/opt/homebrew/bin:/opt/homebrew/opt/python@3.*/bin:/home/linuxbrew/.linuxbrew/bin\
:/Library/Frameworks/Python.framework/Versions/*/bin\
:${HOME:-}/*conda*/bin:${HOME:-}/*conda*/envs/*/bin:${HOME:-}/*forge*/bin"}

# Runs under any Python, prints the interpreter's real path (past shims and virtual environments) or fails with the
# reason. The upper bound is the first Python that locked packages have no wheels for.
probe='
import sys
if not (3, 12) <= sys.version_info[:2] < (3, 15):
    sys.exit("is Python %d.%d" % sys.version_info[:2])
if sys.implementation.name != "cpython" or "t" in sys.abiflags:
    sys.exit("is not the standard CPython")
try:
    import ensurepip, venv
except ImportError:
    sys.exit("has no venv or ensurepip (Debian and Ubuntu: install the package python3-venv)")
print(getattr(sys, "_base_executable", None) or sys.executable)
'

newline='
'
# Candidates are judged by running them: a shim or a link may exist, come first on PATH, and fail.
try_python() {
    if found=$("$1" -c "$probe" 2>&1); then
        python=${found##*"$newline"} # the last line: a shim may warn before it
        return 0
    fi
    refused="$refused
  $1: $(printf '%s\n' "$found" | { read -r line || :; printf '%s' "$line"; })"
    return 1
}

find_python() {
    refused=
    if [ -n "${PYTHON:-}" ]; then
        try_python "$PYTHON" && return
        say "PYTHON cannot be used, looking for another.$refused"
    fi
    for name in python3.12 python3.13 python3.14 python3; do
        if candidate=$(command -v "$name"); then
            try_python "$candidate" && return
        fi
    done
    for name in python3.12 python3.13 python3.14 python3; do
        IFS=:
        for folder in $search; do
            IFS=' '
            if [ -x "$folder/$name" ]; then
                try_python "$folder/$name" && return
            fi
        done
        unset IFS
    done
    if candidate=$(uv python find --system --no-python-downloads '>=3.12,<3.15' 2>/dev/null); then
        try_python "$candidate" && return
    fi
    say "No usable Python 3.12, 3.13 or 3.14 was found."
    [ -z "$refused" ] || say "Tried:$refused"
    say "Install one, with its venv module, and run this again. For example
  Debian, Ubuntu:  apt install python3.12 python3.12-venv
  Fedora:          dnf install python3.12
  macOS:           brew install python@3.12
  anywhere:        pyenv install 3.12    or    uv python install 3.12
or name it:        make setup PYTHON=/path/to/python3.12"
    exit 2
}

if [ "${1:-}" = --find-python ]; then
    find_python
    printf '%s\n' "$python"
    exit
fi

# ---- fill .venv ----------------------------------------------------------------------------------------------------
# Two steps, each ending with a stamp that says what it was made from. A missing or different stamp means that the step
# was interrupted or is out of date: the packages are then installed afresh, since half a package looks like a whole one.

packages_from() { printf '%s\n' "$PWD" "$(.venv/bin/python -V 2>&1)" "$(cksum <requirements.lock)"; }
project_from() { cksum <pyproject.toml; }
is_stamped() { [ -f "$1" ] && [ "$(cat "$1")" = "$2" ]; }

fail() {
    say "Set-up failed; the end of its log, .venv/setup.log:"
    tail -n 12 .venv/setup.log >&2
    if grep -qi 'no space left' .venv/setup.log; then
        say "=> The disk is full: 3 GB are needed, counting pip's cache."
    elif grep -qiE 'hashes are required|do not match the hashes' .venv/setup.log; then
        say "=> A package differs from requirements.lock: a damaged download, or a lock to be made anew with make lock."
    elif grep -qiE 'resolution|connection|timed out|timeout|network is unreachable|proxy|ssl' .venv/setup.log; then
        say "=> The package index could not be reached: check the network and pip's settings (pip config list)."
    elif grep -qi 'no matching distribution' .venv/setup.log; then
        say "=> A locked package has no build for this machine, or the package index lacks it."
    fi
    say "Run make setup again to go on."
    exit 1
}

# Somebody's habits of installing elsewhere, or of finding packages there, are not for this environment.
unset PYTHONPATH PYTHONHOME PIP_TARGET PIP_PREFIX
export PIP_USER=0

# Runs pip, keeps its log, and shows how far it is.
pip_install() {
    status=$(
        { .venv/bin/python -m pip install --no-input --disable-pip-version-check --progress-bar off "$@" 2>&1 && echo done; } |
            tee -a .venv/setup.log | {
                count=0 last=
                while read -r line; do
                    last=$line
                    case $line in
                    Collecting*)
                        count=$((count + 1))
                        [ $((count % 25)) -ne 0 ] || say "  $count of about 100 fetched"
                        ;;
                    Installing\ collected*) [ "$count" -lt 25 ] || say "  writing them to .venv" ;;
                    esac
                done
                printf '%s' "$last"
            }
    )
    [ "$status" = done ] || fail
}

if ! is_stamped .venv/packages.stamp "$(packages_from)"; then
    find_python
    say "Setting up .venv with $("$python" -V), $python"
    "$python" -m venv --clear .venv
    say "Installing the packages of requirements.lock: a minute or so plus the download, 2 GB on disk."
    # The lock is complete, so nothing is resolved: --no-deps keeps pip from asking for what the lock leaves out.
    pip_install --require-hashes --no-deps -r requirements.lock
    packages_from >.venv/packages.stamp
fi

if ! is_stamped .venv/project.stamp "$(project_from)"; then
    pip_install --no-deps --no-build-isolation --editable .
    project_from >.venv/project.stamp
    say "Ready: .venv/bin/swarmnet --help"
fi
