#!/usr/bin/env bash
# Any verb of the program, after installing what it needs and is missing.
#
#   bash scripts/lyra.sh VERB [ARGUMENTS]       as in: bash scripts/lyra.sh render runs/flag
#
# RANKS says on how many ranks (2 for run, else 1).
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/environment.sh"
ranks=${RANKS:-1}
extras=()
case ${1:-} in
    run) ranks=${RANKS:-2} extras=(study) ;;
    render | view) extras=(view) ;;
    export) extras=(export) ;;
    study | stress | verify | fabric | fit | report) extras=(study) ;;
esac
[[ $ranks =~ ^[1-9][0-9]*$ ]] || give_up "RANKS=$ranks is not a number of ranks"
for argument in "$@"; do
    [[ $argument != --live ]] || extras+=(view)
done
# waiting ranks yield their core only if there are more ranks than cores: otherwise other busy programs would take
# nearly all of the time (the variable is read by Open MPI; nproc would take OpenMP's variables for cores)
crowded=0
((ranks <= $(env -u OMP_NUM_THREADS -u OMP_THREAD_LIMIT nproc))) || crowded=1
export OMPI_MCA_mpi_yield_when_idle=${OMPI_MCA_mpi_yield_when_idle:-$crowded}
trap 'exit 143' USR1
set_up "${extras[@]}"
# by the folder's name, as with -m Python would look for the program in the working directory first
export PYTHONSAFEPATH=1
start=("${python[@]}" "$root/lyra_petsc")
# a signal before Python's first line would end it with another exit code; the program unblocks it
! env --block-signal=USR1 true 2>/dev/null || start=(env --block-signal=USR1 "${start[@]}")
((ranks == 1)) || start=("${launcher[@]}" -n "$ranks" "${start[@]}")
exec "${start[@]}" "$@"
