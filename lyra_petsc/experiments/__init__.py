"""Experiments: scenes with something to vary, an answer to compare with, and a verdict.

In: a verb's request (which cases, which scene, which settings). Out: a folder with tables, a file for
programs and a page, and an exit code that says whether all is as expected.

A `case.Case` is one experiment; a verb adds its scene, what is varied and what is expected. `bench` runs its
simulations, a verb's runner turns them into a `case.Outcome` with a `case.Verdict` for each claim, and
`results.Results` runs case after case, on the communicator at hand or through a `case.Launcher` in an mpirun
each, and writes what a verb's `results.View` tells. `case.Registry` finds cases by name and imports their
modules only then; `case.save_record` keeps results beyond a process. Five verbs are views of this:

- `verification`: exact and published answers; varied is the resolution, expected a value and an order.
- `stress`: stiff and extreme scenes; expected are the balances of energy, force and momentum of every step.
- `study`: a scene of the user; varied are its settings, expected is a reference (of `exact_motions`, of a
  finer run), and instead of a verdict it tells which setting gives an accuracy in the least time.
- `fabric`: standard tests of textiles on a material; expected are the numbers that the material has.
- `fit`: parameters of a scene estimated from measurements by least squares, with their intervals.

A further verb brings its cases, a runner, a `View`, and a function in `cli.experiments`.
"""
