#!/usr/bin/env bash
# Runs the whole test suite, after installing what is missing.
#
#   bash scripts/test.sh [pytest arguments]
#
# First all tests, then those marked `parallel` on two and on three ranks. The last line is pytest's
# closing line of all tests. Where there are two cores and no tests are named, all tests are two halves
# in two processes beside each other, each with a closing line, and the last line adds these up.
set -euo pipefail

# What takes about half of the time; whatever else there is in tests/ is the other half.
first_half=(tests/cli tests/surviving)

source "$(dirname -- "${BASH_SOURCE[0]}")/environment.sh"

# pytest starts in the checkout, where its settings are; a path given from elsewhere must still hold
arguments=()
selection=parallel
halves=yes # but for options that ask for one process, such as --co, --pdb, --junitxml, and for paths
previous=
for argument in "$@"; do
    if [[ ! $previous =~ ^-[km]$ && ! $argument =~ ^(-[km].*|-[qvxls]+|-r.+|--(tb|maxfail|durations)=.*)$ ]]; then
        halves=no
    fi
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
trap 'exit 130' INT
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
# keep CODE: the exit code of the first failure is the script's
keep() { if ((code == 0)); then code=$1; fi; }

# run_halves: both at once; the second one's words are shown when both are done
run_halves() {
    local one=0 two=0
    say "tests on 1 rank, first half: ${first_half[*]}; the others beside it, shown after it"
    # a group of its own: in one that the shell starts in the background, and in all that it starts,
    # an interrupt would be ignored
    set -m
    pytest_on 1 "${arguments[@]}" "${first_half[@]/#/--ignore=}" -o cache_dir="$logs/cache" \
        >"$logs/part-1b" 2>&1 </dev/null &
    other=$!
    set +m
    trap 'kill -TERM -- "-$other" 2>/dev/null && wait "$other" || true; rm -rf -- "$logs"' EXIT
    pytest_on 1 "${arguments[@]}" "${first_half[@]}" 2>&1 | tee "$logs/part-1a" || one=${PIPESTATUS[0]}
    wait "$other" || two=$?
    trap 'rm -rf -- "$logs"' EXIT
    say "tests on 1 rank, second half"
    cat -- "$logs/part-1b"
    # a selection need not have tests in both
    if ((one == 5)); then one=$two; elif ((two == 5)); then two=0; fi
    keep "$one"
    keep "$two"
}

# run_part RANKS: shows it and keeps its words
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
    keep "$result"
}

# `nproc` would go by the threads that we allow each process
[[ $halves == no ]] || (($(env -u OMP_NUM_THREADS nproc 2>/dev/null || echo 1) > 1)) || halves=no

if [[ $halves == yes ]]; then run_halves; else run_part 1 "${arguments[@]}"; fi
run_part 2 "${arguments[@]}" -m "$selection"
run_part 3 "${arguments[@]}" -m "$selection"

# closing PART: pytest's "=== 12 passed in 3.45s ===", or else the last that it said
closing() {
    sed 's/\x1b\[[0-9;]*m//g' "$logs/part-$1" | tr -d '\r' >"$logs/plain"
    grep -E ' in [0-9.]+s' "$logs/plain" | tail -n 1 || tail -n 1 "$logs/plain"
}

# sum: one closing line for those of both halves
sum() {
    awk '
        / in [0-9.]+s/ {
            halves++
            match($0, / in [0-9.]+s/)
            lasted = substr($0, RSTART + 4, RLENGTH - 5) + 0
            if (lasted > longest) longest = lasted
            number = split(substr($0, 1, RSTART - 1), counts, ",")
            for (i = 1; i <= number; i++) {
                gsub(/^[= ]+/, "", counts[i])
                split(counts[i], words, " ")
                sub(/s$/, "", words[2])
                if (words[1] ~ /^[0-9]+$/) total[words[2]] += words[1]
            }
        }
        END {
            number = split("failed passed skipped deselected xfailed xpassed warning error", order, " ")
            for (i = 1; i <= number; i++) {
                name = order[i]
                plural = (i > 6 && total[name] > 1) ? "s" : ""
                if (total[name]) line = line ", " total[name] " " name plural
            }
            if (halves < 2) line = line ", " 2 - halves " of 2 processes ended early"
            line = line ? substr(line, 3) : "no tests ran"
            printf "=== %s in %.2fs (%d:%02d:%02d) ===\n", line, longest, longest / 3600, longest / 60 % 60, longest % 60
        }'
}

for ranks in 3 2; do
    say "tests on $ranks rank(s) closed with"
    closing "$ranks"
done
if [[ $halves == no ]]; then
    say "tests on 1 rank(s) closed with"
    closing 1
else
    say "tests on 1 rank closed, by halves, with"
    closing 1a
    closing 1b
    { closing 1a && closing 1b; } | sum
fi
exit "$code"
