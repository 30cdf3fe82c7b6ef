# Sourced by tools/demo and tools/check: makes .venv and installs the project in it, with what $1 names
# (an extra, or nothing). Works on a fresh Debian 12 or Ubuntu with python3 >= 3.11; as root, or with sudo,
# it installs Debian's python3-venv where that is missing. Once installed, a second run takes a second.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
extra=${1:-}

say() { printf '\033[1m%s\033[0m\n' "$*" >&2; }

python=
for candidate in python3 python3.13 python3.12 python3.11; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        python=$candidate
        break
    fi
done
if [ -z "$python" ]; then
    say "Python 3.11 or newer is needed: apt-get install python3"
    exit 1
fi

if [ ! -x .venv/bin/pip ]; then
    rm -rf .venv
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        say "installing Debian's python3-venv"
        sudo=$([ "$(id -u)" = 0 ] || echo sudo)
        $sudo apt-get update -qq && $sudo apt-get install -y -qq python3-venv >&2
    fi
    say "making the environment .venv"
    "$python" -m venv .venv
fi

wanted=$(cat pyproject.toml tools/constraints.txt | sha256sum)
if [ "$(cat .venv/installed${extra:+-$extra} 2>/dev/null)" != "$wanted" ]; then
    say "installing the project and what it needs (once, a few minutes on a slow line)"
    .venv/bin/pip install --quiet --disable-pip-version-check -c tools/constraints.txt \
        -e ".${extra:+[$extra]}" 2> >(grep -v '^WARNING: Location' >&2)
    echo "$wanted" > .venv/installed${extra:+-$extra}
fi
