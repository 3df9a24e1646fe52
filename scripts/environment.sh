# Sourced by lyra.sh, test.sh and .ci/run: finds a Python that sees petsc4py and mpi4py, or installs
# the distribution's, and lays what is missing from PyPI over it in .venv.
#
#   set_up [EXTRA...]     afterwards the arrays python and launcher hold the commands that start
#                         the interpreter and, followed by -n RANKS, MPI programs
#
# Variables a user may set: PYTHON (interpreter with petsc4py), LYRA_VENV (instead of .venv),
# MPIRUN (launcher with its own options, e.g. "srun --mpi=pmix").

root=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd)
venv=${LYRA_VENV:-$root/.venv}
[[ $venv == /* ]] || venv=$PWD/$venv
helper=$root/scripts/environment.py
mark=$venv/made-by-lyra-petsc # tells our .venv from one made by hand
packages=(python3-petsc4py-real python3-petsc4py python3-mpi4py python3-h5py python3-h5py-mpi python3-gmsh
    python3-numpy python3-venv openmpi-bin)
# not needed, but factorisations take less than half the time with an optimised BLAS
faster=(libopenblas0-serial)
# OpenGL without a display, for the extra "view"
pictures=(libegl1)
# the tests open the page of `view`
browser=(chromium chromium-driver)
manual="see \"Other ways to install\" in README.md"

# empty entries stand for the working directory, whose files may be a stranger's
PYTHONPATH=$(tr -s : <<<":${PYTHONPATH:-}:")
PYTHONPATH=${PYTHONPATH#:} PYTHONPATH=${PYTHONPATH%:}
[[ $PYTHONPATH ]] || unset PYTHONPATH

say() { printf 'set-up: %s\n' "$*" >&2; }
give_up() {
    say "$*"
    exit 1
}

# --- which interpreter has petsc4py --------------------------------------------------------------

# probe COMMAND [DIR...]: sets base, base_version, petsc_version, owner and folders
probe() {
    local facts command
    command=$(command -v -- "$1") || return 1
    shift
    facts=$("$command" -B "$helper" probe "$@" 2>/dev/null) || return 1
    mapfile -t facts <<<"$facts"
    base=${facts[0]} base_version=${facts[1]} petsc_version=${facts[2]} owner=${facts[3]}
    folders=("${facts[@]:4}")
    [[ $base != "$venv"/* ]] # our own .venv, activated: what it lies over is looked for
}

# Debian's petsc4py lies beside its PETSc, outside the interpreter's path
probe_distribution() {
    local folder
    probe /usr/bin/python3 && return
    for folder in /usr/lib/petscdir/petsc*/*-real/lib/python3/dist-packages; do
        [[ -d $folder/petsc4py ]] && probe /usr/bin/python3 "$folder" && return
    done
    return 1
}

find_stack() {
    local candidate chosen
    chosen=$(command -v -- "${PYTHON:-}" || true)
    # the distribution's own may not have its petsc4py yet, and our .venv stands for what it lies over
    if [[ -n ${PYTHON:-} && ! $chosen =~ ^(/usr)?/bin/python3?$ && $chosen != "$venv"/* ]]; then
        probe "$PYTHON" || give_up "PYTHON=$PYTHON does not see petsc4py and mpi4py;" \
            "install them there, or unset PYTHON to use another interpreter"
        return
    fi
    for candidate in python3 python; do probe "$candidate" && return; done
    [[ -f $mark ]] && probe "$(head -n 1 "$mark")" && return
    probe_distribution
}

at_least() { [[ $(printf '%s\n%s\n' "$2" "$1" | sort -V | head -n 1) == "$2" ]]; }

check_versions() {
    at_least "$petsc_version" 3.18 ||
        give_up "petsc4py of $base is $petsc_version, lyra_petsc needs 3.18 or newer; $manual"
    at_least "$base_version" 3.10 ||
        give_up "$base is Python $base_version, lyra_petsc needs 3.10 or newer; $manual"
}

# --- the distribution's packages -----------------------------------------------------------------

is_installed() { [[ $(dpkg-query -W -f '${db:Status-Status}' "$1" 2>/dev/null) == installed ]]; }

has_egl() { PATH=$PATH:/usr/sbin:/sbin ldconfig -p 2>/dev/null | grep 'libEGL\.so\.1' >/dev/null; }

apt() { "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -o DPkg::Lock::Timeout=300 "$@"; }

# install_packages NAME...: those not installed yet, with as few rights and words as it takes
install_packages() {
    local name wanted=() offered log
    for name in "$@"; do is_installed "$name" || wanted+=("$name"); done
    ((${#wanted[@]})) || return 0
    command -v apt-get >/dev/null ||
        give_up "no Python with petsc4py and mpi4py found, and this system has no apt-get; $manual"
    as_root=()
    if ((EUID != 0)); then
        if command -v sudo >/dev/null && { sudo -n true 2>/dev/null || [[ -t 0 ]]; }; then
            as_root=(sudo)
        else
            give_up "these packages are missing and installing them takes root:" \
                "apt-get install --no-install-recommends ${wanted[*]}"
        fi
    fi
    log=$(mktemp)
    say "refreshing the package lists"
    apt update >"$log" 2>&1 || say "apt-get update had trouble: $(tail -n 1 "$log"); trying all the same"
    offered=$(apt-cache policy python3-petsc4py-real | sed -n 's/^ *Candidate: //p')
    [[ $offered && $offered != "(none)" ]] ||
        give_up "this distribution does not offer the package python3-petsc4py-real; $manual"
    at_least "$offered" 3.18 ||
        give_up "this distribution offers petsc4py $offered, lyra_petsc needs 3.18 or newer; $manual"
    say "installing ${wanted[*]} (a minute or two)"
    if ! apt install -y --no-install-recommends "${wanted[@]}" </dev/null >"$log" 2>&1; then
        tail -n 15 "$log" >&2
        rm -f "$log"
        give_up "apt-get could not install ${wanted[*]}"
    fi
    rm -f "$log"
}

# --- what comes from PyPI ------------------------------------------------------------------------

# what .venv is made of; another answer than the one noted in it means: make it anew
foundation() {
    printf '%s\n' "$base" "$base_version" "$petsc_version" "$venv" "${folders[@]}"
    cat "$root/scripts/environment.sh" "$helper" | cksum
}

fingerprint() {
    foundation
    cksum <"$root/pyproject.toml"
}

is_up_to_date() { # EXTRA
    [[ -x $venv/bin/python && -f $venv/ready-$1 && $(<"$venv/ready-$1") == "$(fingerprint)" ]]
}

make_venv() {
    local log
    if [[ -e $venv && ! -f $mark ]] && [[ ! -d $venv || -n $(ls -A "$venv") ]]; then
        give_up "$venv was not made by these scripts and is left alone: activate it if it has petsc4py," \
            "or set LYRA_VENV to another place"
    fi
    # a half-made one, or one over another interpreter, is made anew
    [[ -f $mark && $(<"$mark") == "$(foundation)" && -x $venv/bin/python && -f $venv/constraints.txt ]] && return
    say "making $venv over $base (Python $base_version, petsc4py $petsc_version)"
    rm -rf -- "$venv"
    mkdir -p -- "$venv" 2>/dev/null || give_up "cannot write $venv; set LYRA_VENV to a folder you may write"
    log=$venv/set-up.log
    foundation >"$mark"
    "$base" -IB -m venv "$venv" >"$log" 2>&1 ||
        give_up "$base -m venv failed: $(tail -n 1 "$log") (on Debian and Ubuntu: apt-get install python3-venv)"
    "$base" -B "$helper" layer "$venv/bin/python" "${folders[@]}" >"$venv/constraints.new"
    mv -- "$venv/constraints.new" "$venv/constraints.txt"
}

# lock: two set-ups of one .venv follow one another (until descriptor 9 is closed)
lock() {
    { exec 9>"$venv.lock"; } 2>/dev/null ||
        give_up "cannot write $venv.lock; set LYRA_VENV to a folder you may write"
    command -v flock >/dev/null || return 0
    flock -n 9 || { say "waiting for another set-up of $venv" && flock 9; }
}

# install_missing EXTRA...: the requirements of the project and of these extras ("run" for none) that are not met
install_missing() {
    local extra wanted log=$venv/set-up.log
    wanted=$("$venv/bin/python" -B "$helper" missing "$root/pyproject.toml" "${@/#run/stack}")
    [[ -z $wanted ]] || mapfile -t wanted <<<"$wanted"
    if [[ -n $wanted ]]; then
        say "installing from PyPI into $venv: ${wanted[*]}"
        # the variables would lead pip elsewhere than into the environment
        if ! env -u PIP_TARGET -u PIP_PREFIX PIP_USER=0 "$venv/bin/python" -I -m pip install --no-input \
            --disable-pip-version-check -c "$venv/constraints.txt" "${wanted[@]}" >"$log" 2>&1; then
            tail -n 5 "$log" >&2
            give_up "pip could not install these; its whole output is in $log"
        fi
    fi
    for extra in "$@"; do fingerprint >"$venv/ready-$extra"; done
}

# --- the launcher --------------------------------------------------------------------------------

find_launcher() {
    local beside
    beside=$(dirname -- "$base")/mpirun
    if [[ -n ${MPIRUN:-} ]]; then
        read -r -a launcher <<<"$MPIRUN"
    elif [[ $owner == distribution && -x /usr/bin/mpirun.openmpi ]]; then
        launcher=(/usr/bin/mpirun.openmpi) # not the one of an activated conda environment
    elif [[ -x $beside ]]; then
        launcher=("$beside")
    else
        launcher=(mpirun)
    fi
    command -v -- "${launcher[0]}" >/dev/null || give_up "${launcher[0]} not found: install the MPI that mpi4py" \
        "of $base was built with, load its module, or set MPIRUN to its launcher"
}

set_launcher_environment() {
    # read by Open MPI alone, 4 and 5: more ranks than cores, shared ones, and root inside a container
    export OMPI_MCA_rmaps_base_oversubscribe=${OMPI_MCA_rmaps_base_oversubscribe:-1}
    export OMPI_MCA_mpi_yield_when_idle=${OMPI_MCA_mpi_yield_when_idle:-1} # cores may be shared
    export PRTE_MCA_rmaps_default_mapping_policy=${PRTE_MCA_rmaps_default_mapping_policy:-:oversubscribe}
    if ((EUID == 0)); then
        export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
        export PRTE_ALLOW_RUN_AS_ROOT=1 PRTE_ALLOW_RUN_AS_ROOT_CONFIRM=1
    fi
    export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} # the ranks are the parallelism
}

# --- all together --------------------------------------------------------------------------------

set_up() {
    local extra extras=(run "$@") site lacking=()
    if ! find_stack; then
        install_packages "${packages[@]}" "${faster[@]}"
        find_stack || give_up "petsc4py and mpi4py are installed but no interpreter sees them; $manual"
    fi
    check_versions
    if [[ $owner == distribution ]] && ! { [[ -x /usr/bin/mpirun ]] && is_up_to_date run; }; then
        install_packages "${packages[@]}"
    fi
    if [[ $owner == distribution && " $* " == *" view "* ]] && ! has_egl; then
        install_packages "${pictures[@]}"
    fi
    if [[ $owner == distribution && " $* " == *" test "* ]] && ! command -v chromedriver >/dev/null; then
        (install_packages "${browser[@]}") || say "the tests that need a browser are skipped"
    fi
    if [[ $owner == environment && -z $("$base" -B "$helper" missing "$root/pyproject.toml" stack "$@") ]]; then
        python=("$base") # the environment in use has everything
        export PYTHONPATH=$root${PYTHONPATH:+:$PYTHONPATH}
    else
        for extra in "${extras[@]}"; do is_up_to_date "$extra" || lacking+=("$extra"); done
        if ((${#lacking[@]})); then
            lock
            make_venv
            install_missing "${lacking[@]}"
            exec 9>&-
        fi
        python=("$venv/bin/python")
        site=$(echo "$venv"/lib/python3*/site-packages)
        # what a module or the user put on PYTHONPATH must not hide what .venv holds for us
        export PYTHONPATH=$root:$site${PYTHONPATH:+:$PYTHONPATH}
    fi
    find_launcher
    set_launcher_environment
}
