"""Contact and friction of sheets with themselves, each other and obstacles.

In: positions of sheets and obstacles. Out: near pairs, energies, forces and Hessians of the barrier and of
friction, and the collision-free part of a displacement; `barrier` and `friction` are the terms.
"""
