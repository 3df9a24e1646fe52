#!/usr/bin/env bash
# Any verb of the program, after installing what it needs and is missing.
#
#   bash scripts/lyra.sh VERB [ARGUMENTS]       as in: bash scripts/lyra.sh render runs/flag
#
# RANKS says on how many ranks (2 for run, else 1).
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/environment.sh"
source "$root/scripts/share_cores.sh"
ranks=${RANKS:-1}
extras=()
case ${1:-} in
    run) ranks=${RANKS:-2} ;;
    render | view) extras=(view) ;;
    export) extras=(export) ;;
    study | stress | verify | report) extras=(study) ;;
esac
[[ $ranks =~ ^[1-9][0-9]*$ ]] || give_up "RANKS=$ranks is not a number of ranks"
for argument in "$@"; do
    [[ $argument != --live ]] || extras+=(view)
done
share_cores "$ranks"
set_up "${extras[@]}"
start=("${python[@]}" -m lyra_petsc)
((ranks == 1)) || start=("${launcher[@]}" -n "$ranks" "${start[@]}")
exec "${start[@]}" "$@"
