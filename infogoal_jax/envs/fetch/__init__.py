"""The Fetch robot: `environment` holds the tasks; model, vectors, multibody, contacts, constraints, solver and physics
what they stand on."""
