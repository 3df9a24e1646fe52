"""Bending, two models side by side: hinges (one per interior edge), and directors (one unknown per edge).

In: positions, with the unknowns of edges. Out: energies, forces and Hessians. The terms are `hinge` and
`midedge`.
"""
