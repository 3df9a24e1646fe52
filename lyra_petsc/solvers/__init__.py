"""PETSc options: presets per problem, precedence, unused ones; and failures in words."""
