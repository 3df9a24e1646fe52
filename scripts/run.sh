#!/usr/bin/env bash
# Simulates a scene in parallel, after installing what is missing.
#
#   bash scripts/run.sh [SCENE] [--our options] [-petsc options]
#
# Without a scene it runs configs/flag.yaml. RANKS (2) says on how many ranks.
exec bash "$(dirname -- "${BASH_SOURCE[0]}")/lyra.sh" run "$@"
