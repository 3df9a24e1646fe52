#!/usr/bin/env bash
# Runs the whole test suite, after installing what is missing.
#
#   bash scripts/test.sh [pytest arguments]
#
# First all tests in one process, then those marked `parallel` on two and on three ranks. The last
# line is pytest's closing line of the whole suite.
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/environment.sh"

# pytest starts in the checkout, where its settings are; a path given from elsewhere must still hold
arguments=()
selection=parallel
previous=
for argument in "$@"; do
    [[ $previous != -m ]] || selection="($argument) and parallel"
    [[ $argument != -m?* ]] || selection="(${argument#-m}) and parallel"
    if [[ $argument != [-/]* && $previous != -[a-z] && $PWD != "$root" && -e ${argument%%::*} ]]; then
        arguments+=("$PWD/$argument")
    else
        arguments+=("$argument")
    fi
    previous=$argument
done

set_up test study view export
cd -- "$root"
logs=$(mktemp -d)
trap 'rm -rf -- "$logs"' EXIT
export LYRA_TEST_LOGS=$logs

# Rank 0 speaks, the others write to a file that is shown when something fails. Each has a cache of
# its own, as --last-failed must not select different tests on different ranks.
one_rank='rank=${OMPI_COMM_WORLD_RANK:-${PMIX_RANK:-${PMI_RANK:-${SLURM_PROCID:-0}}}}
set -- "$@" -o cache_dir="$LYRA_TEST_LOGS/cache-$rank"
if [ "$rank" = 0 ]; then "$@"; else "$@" >"$LYRA_TEST_LOGS/rank-$rank" 2>&1; fi
code=$?
if [ $code = 5 ]; then exit 0; fi # none of the selected tests need be a parallel one
exit $code'

limit=() # ranks that wait for each other for ever must not hold up everything
! command -v timeout >/dev/null || limit=(timeout --kill-after=10 "${LYRA_TEST_TIMEOUT:-1500}")

# the terminal is behind a pipe here, and mpirun pretends to be one
color=no
[[ ! -t 1 ]] || color=yes

# pytest_on RANKS ARGUMENT...
pytest_on() {
    local ranks=$1 command=("${python[@]}" -m pytest --color="$color")
    shift
    if ((ranks > 1)); then
        command=("${limit[@]}" "${launcher[@]}" -n "$ranks" sh -c "$one_rank" sh "${command[@]}")
    fi
    "${command[@]}" "$@"
}

code=0
# run_part RANKS ARGUMENT...: shows it, keeps its words, and its exit code if it is the first failure
run_part() {
    local ranks=$1 result=0 file
    say "tests on $ranks rank(s)"
    pytest_on "$@" 2>&1 | tee "$logs/part-$ranks" || result=${PIPESTATUS[0]}
    if ((result != 0 && ranks > 1)); then
        for file in "$logs"/rank-*; do
            if [[ -s $file ]]; then
                printf -- '--- %s of %s: the last lines ---\n' "${file##*/}" "$ranks"
                tail -n 60 -- "$file"
            fi
        done
    fi
    rm -f -- "$logs"/rank-*
    if ((code == 0)); then code=$result; fi
}

run_part 1 "${arguments[@]}"
run_part 2 "${arguments[@]}" -m "$selection"
run_part 3 "${arguments[@]}" -m "$selection"

# pytest's "=== 12 passed in 3.45s ===" of each part
for ranks in 3 2 1; do
    say "tests on $ranks rank(s) closed with"
    sed 's/\x1b\[[0-9;]*m//g' "$logs/part-$ranks" | tr -d '\r' >"$logs/plain"
    grep -E ' in [0-9.]+s' "$logs/plain" | tail -n 1 || tail -n 1 "$logs/plain"
done
exit "$code"
