#!/usr/bin/env bash
# Simulates a scene in parallel, after installing what is missing.
#
#   bash scripts/run.sh [SCENE] [--our options] [-petsc options]
#
# Without a scene it runs configs/flag.yaml. RANKS (2) says on how many ranks.
set -euo pipefail
source "$(dirname -- "${BASH_SOURCE[0]}")/environment.sh"
source "$root/scripts/share_cores.sh"
ranks=${RANKS:-2}
[[ $ranks =~ ^[1-9][0-9]*$ ]] || give_up "RANKS=$ranks is not a number of ranks"
share_cores "$ranks"
set_up study
exec "${launcher[@]}" -n "$ranks" "${python[@]}" -m lyra_petsc run "$@"
