#!/usr/bin/env bash
# Runs the tests, after installing what is missing.
#
#   bash scripts/test.sh [--quick] [pytest arguments]
#
# First all tests, in two processes a core (at most four), as many tests wait for other programs; then those marked
# `parallel`, under mpirun on two and on three ranks. With --quick only tests marked `quick` run, some of each kind,
# within a minute: those marked `parallel` on two ranks, the others on one. With -s, -n 0 or the name of a file all
# tests run in one process. The last line is pytest's closing line of the first part, the exit code that of the first failure.
set -euo pipefail

source "$(dirname -- "${BASH_SOURCE[0]}")/environment.sh"

arguments=() kinds=() marks=() paths=() counts=(1 2 3) previous=
workers=$(env -u OMP_NUM_THREADS nproc 2>/dev/null || echo 1) # the variable would make it 1
workers=$((workers > 2 ? 4 : 2 * workers))
for argument in "$@"; do
    file=${argument%%::*}
    if [[ $argument == --quick ]]; then
        kinds=(quick)
        counts=(1 2)
    elif [[ $previous == -m || $argument == -m?* ]]; then
        marks+=("(${argument#-m})")
    elif [[ $previous == -[a-z] || $argument == -* ]]; then
        [[ $argument == -m ]] || arguments+=("$argument")
        [[ $argument != -s ]] || workers=0
    else
        # pytest starts in the checkout, where its settings are; a path given from elsewhere must still hold
        [[ ! -e $file || $file == /* ]] || argument=$PWD/$argument
        paths+=("$argument")
        [[ $file != *.py ]] || workers=0
    fi
    previous=$argument
done

set_up test study view export
cd -- "$root"
logs=$(mktemp -d)
trap 'rm -rf -- "$logs"' EXIT
trap 'exit 130' INT
export LYRA_TEST_LOGS=$logs PYTEST_XDIST_AUTO_NUM_WORKERS=$workers

# Rank 0 prints, the others write to a file that is shown if a test fails. Each rank has its own cache, as
# --last-failed must not select different tests on different ranks.
one_rank='rank=${OMPI_COMM_WORLD_RANK:-${PMIX_RANK:-${PMI_RANK:-${SLURM_PROCID:-0}}}}
set -- "$@" -o cache_dir="$LYRA_TEST_LOGS/cache-$rank"
if [ "$rank" = 0 ]; then "$@"; else "$@" >"$LYRA_TEST_LOGS/rank-$rank" 2>&1; fi
code=$?
if [ $code = 5 ]; then exit 0; fi # none of the selected tests need be a parallel one
exit $code'

limit=() # ends ranks that deadlock
! command -v timeout >/dev/null || limit=(timeout --foreground --kill-after=10 "${LYRA_TEST_TIMEOUT:-1500}")

# the terminal is behind a pipe here, and mpirun pretends to be one
color=no
[[ ! -t 1 ]] || color=yes

# files_with KIND...: the files that have tests marked so; to import all others would take seconds
files_with() {
    local kind files=("${paths[@]%%::*}")
    ((${#files[@]})) || files=(tests)
    for kind in "$@"; do
        mapfile -t files < <(grep -rlw --include='test_*.py' "pytest\.mark\.$kind" "${files[@]}" | sort)
        ((${#files[@]})) || return 0
    done
    printf '%s\n' "${files[@]}"
}

code=0
parts=()
# run_part RANKS: runs the tests of this number of ranks, shows pytest's output and keeps it
run_part() {
    local ranks=$1 result=0 file files selection wanted=("${kinds[@]}") alone=()
    local command=("${python[@]}" -m pytest --color="$color")
    if ((ranks == 1)); then
        command+=(-n auto --dist worksteal)
        ((${#kinds[@]} == 0)) || alone=("not parallel")
    else
        command=("${limit[@]}" "${launcher[@]}" -n "$ranks" sh -c "$one_rank" sh "${command[@]}")
        wanted+=(parallel)
    fi
    mapfile -t files < <(files_with "${wanted[@]}")
    ((ranks == 1 || ${#files[@]})) || return 0
    ((${#paths[@]} == 0)) || files=("${paths[@]}")
    parts=("$ranks" "${parts[@]}")
    selection=$(printf ' and %s' "${wanted[@]}" "${alone[@]}" "${marks[@]}")
    say "tests on $ranks rank(s)"
    # tee must survive an interrupt, to show pytest's output about it
    "${command[@]}" "${files[@]}" "${arguments[@]}" -m "${selection# and }" 2>&1 |
        tee -i "$logs/part-$ranks" || result=${PIPESTATUS[0]}
    if ((result != 0 && ranks > 1)); then
        for file in "$logs"/rank-*; do
            if [[ -s $file ]]; then
                printf -- '--- %s of %s: the last lines ---\n' "${file##*/}" "$ranks"
                tail -n 60 -- "$file"
            fi
        done
    fi
    rm -f -- "$logs"/rank-*
    ((code != 0)) || code=$result
}

for ranks in "${counts[@]}"; do run_part "$ranks"; done

# pytest's "=== 12 passed in 3.45s ===", else its last line
for ranks in "${parts[@]}"; do
    say "tests on $ranks rank(s) closed with"
    sed 's/\x1b\[[0-9;]*m//g' "$logs/part-$ranks" | tr -d '\r' >"$logs/plain"
    grep -E ' in [0-9.]+s' "$logs/plain" | tail -n 1 || tail -n 1 "$logs/plain"
done
exit "$code"
