"""Experiments: a scene, the settings that are varied, a reference to compare with, and a verdict.

In: the request of a verb of the command line (cases, scene, settings). Out: a folder with a table, a JSON
file and a page, and an exit code that says whether all results are as expected.

A `case.Case` is one experiment. Each verb adds the scene, the varied settings and the expected result.
`bench` runs the simulations of a case; the runner of the verb turns them into a `case.Outcome` with one
`case.Verdict` per claim. `results.Results` runs the cases one after another, on the present communicator or
through a `case.Launcher` with one mpirun each, and writes the tables and the page that the `results.View` of
the verb defines. `case.Registry` finds cases by name and imports their modules on demand; `case.save_record`
stores results as JSON. Five verbs are views of this framework:

- `verification`: comparison with exact and published solutions; varied: the resolution; expected: a value and
  an order of convergence.
- `stress`: stiff and extreme scenes; expected: the balances of energy, force and momentum of every step.
- `study`: a scene of the user; varied: its settings; reference: an exact solution (`exact_motions`) or a
  finer run. It has no verdict, but names the setting that reaches an accuracy in the least run time.
- `fabric`: standard textile tests of a material; expected: the known constants of the material.
- `fit`: parameters of a scene, estimated from measurements by least squares, with confidence intervals.

A further verb needs cases, a runner, a `View`, and a function in `cli.experiments`.
"""
