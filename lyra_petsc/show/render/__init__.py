"""Pictures and films of a run, drawn off-screen, and a script that opens the run in ParaView.

In: a run's folder and the options of ``render``, which `render_plan` checks first. Out: PNG files and films,
drawn by `draw`.
"""
