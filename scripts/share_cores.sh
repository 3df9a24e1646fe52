# Sourced by run.sh and lyra.sh, before the set-up.
#
#   share_cores RANKS     a rank that waits gives its core away only where there are more ranks than cores: beside
#                         other programs, which take what is given, a run would hardly get on (read by Open MPI)
share_cores() {
    local crowded=0
    # nproc takes the variables of OpenMP for the number of cores
    (($1 <= $(env -u OMP_NUM_THREADS -u OMP_THREAD_LIMIT nproc))) || crowded=1
    export OMPI_MCA_mpi_yield_when_idle=${OMPI_MCA_mpi_yield_when_idle:-$crowded}
}
