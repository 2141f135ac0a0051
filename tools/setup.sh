# Sourced by tools/demo, tools/test and .ci/run: `prepare` creates .venv, installs the project into it, makes sure that
# OpenGL works, and compiles what is compiled on first use. It skips what is already done.
# PYTHON=/path/to/python3.12 names the Python to use.

set -euo pipefail
# commands and tests start many processes; without compiled files each of them compiles hundreds of modules again
unset PYTHONDONTWRITEBYTECODE
cd -P -- "$(dirname -- "${BASH_SOURCE[0]}")/.." >/dev/null

opengl=(libegl1 libgl1 libgl1-mesa-dri)  # Debian's and Ubuntu's names
again="bash $0"

say() { printf '%s\n' "$*"; }

stop() {
    printf '%s\n' "$*" >&2
    exit 1
}

# "3.11 /usr": version and prefix of a Python; a virtual environment has those of the Python that made it
identity_of() {
    "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2], sys.base_prefix)' 2>/dev/null
}

is_supported() {
    [[ $1 =~ ^3\.1[0-4]\  ]]
}

find_python() {
    local candidate identity seen=""
    local candidates=(python3 python3.14 python3.13 python3.12 python3.11 python3.10)
    [ -z "${PYTHON:-}" ] || candidates=("$PYTHON")
    for candidate in "${candidates[@]}"; do
        identity=$(identity_of "$candidate") || continue
        if is_supported "$identity"; then
            python=$candidate
            return
        fi
        seen=${seen:-$candidate is ${identity%% *}}
    done
    stop "Python must be 3.10 to 3.14 (got: ${seen:-no ${candidates[0]} that runs}); install one, or name one with 'PYTHON=/path/to/python3.12 $again'."
}

# fails without apt, or without the right to use it
apt_install() {
    local as_root=() output
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" != 0 ]; then
        sudo -n true 2>/dev/null || return 1
        as_root=(sudo -n)
    fi
    as_root+=(env DEBIAN_FRONTEND=noninteractive apt-get -qq -y --no-install-recommends)
    say "Installing with apt: $*"
    if ! output=$( ("${as_root[@]}" update && "${as_root[@]}" install "$@") </dev/null 2>&1); then
        tail -n 5 <<<"$output" >&2
        return 1
    fi
}

install_or_stop() {
    apt_install "$@" || stop "Some system packages are missing: run 'apt-get install $*' as root, then '$again' again."
}

# keeps .venv unless it was made elsewhere, or by another Python, or is incomplete
make_venv() {
    local python missing=() identity made_by=""
    if identity=$(identity_of .venv/bin/python) && is_supported "$identity"; then
        [ ! -f .venv/made-by ] || made_by=$(<.venv/made-by)
        if [ -z "${PYTHON:-}" ] || [ "$(identity_of "$PYTHON")" = "$identity" ]; then
            [ "$made_by" != "$identity in $PWD" ] || return 0
            [ -n "$made_by" ] || ! .venv/bin/python -m pip --version >/dev/null 2>&1 || return 0
        fi
    fi
    find_python
    identity=$(identity_of "$python")
    "$python" -c 'import ensurepip' 2>/dev/null || missing+=("python${identity%% *}-venv")
    "$python" -c 'import ctypes; [ctypes.CDLL(f"lib{name}.so.1") for name in ("EGL", "GL")]' 2>/dev/null ||
        missing+=("${opengl[@]}")
    [ ${#missing[@]} = 0 ] || install_or_stop "${missing[@]}"
    say "Making .venv with Python ${identity%% *}"
    "$python" -m venv --clear .venv
    printf '%s\n' "$identity in $PWD" >.venv/made-by
}

# [extra]; pip shows its progress, with bars on a terminal
install_project() {
    local extra=${1:-} checksum
    checksum=$(cat setup.cfg pyproject.toml sonar_gl/_version.py | sha256sum)
    [ "$(cat ".venv/installed$extra" 2>/dev/null)" != "$checksum" ] || return 0
    say "Installing sonar_gl${extra:+ and what its ${extra}s need} into .venv (a minute or two)"
    rm -f .venv/checked
    PIP_USE_PEP517=1 .venv/bin/python -m pip install --disable-pip-version-check -e ".${extra:+[$extra]}" </dev/null
    # that which pyrender asks for cannot pass arrays there, as pip then says
    [ "$extra" != test ] || .venv/bin/python -c 'import sys; sys.exit(sys.version_info >= (3, 14))' ||
        .venv/bin/python -m pip install --disable-pip-version-check 'PyOpenGL>=3.1.6' </dev/null
    printf '%s\n' "$checksum" | tee ".venv/installed$extra" >.venv/installed
}

try_opengl() {
    .venv/bin/python -c '
import sys
from sonar_gl.gl import context
try:
    context.create_context().release()
except context.Error as why:
    sys.exit(str(why))' 2>&1
}

check_opengl() {
    local why
    why=$(try_opengl) && return
    ! apt_install "${opengl[@]}" || ! why=$(try_opengl) || return 0
    stop "${why:-OpenGL does not start through EGL, and does not say why}"
}

# after an installation: `doctor` compiles all that is compiled on first use, so that the first command starts fast
check_installation() {
    local report
    [ ! -f .venv/checked ] || return 0
    say "Compiling, and checking the installation (a minute or two; on one core some minutes)"
    report=$(.venv/bin/sonar-gl doctor </dev/null) || stop "$report"
    touch .venv/checked
}

# tests of hosts with a window need it
find_display() {
    command -v Xvfb >/dev/null || apt_install xvfb ||
        say "Tests that need a display are left out: 'apt-get install xvfb' as root brings them in."
}

# tests with another vendor of DDS compile a program; only CI installs a compiler for it
find_fast_dds() {
    { command -v g++ && [ -d /usr/include/fastrtps ]; } >/dev/null || apt_install g++ libfastrtps-dev ||
        say "Tests with another vendor of DDS are left out: 'apt-get install g++ libfastrtps-dev' as root brings them in."
}

# [extra]: the shell stands in the repository root; .venv/bin holds the commands
prepare() {
    make_venv
    install_project "$@"
    check_opengl
    check_installation
    [ "${1:-}" != test ] || find_display
}
