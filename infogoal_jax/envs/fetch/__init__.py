"""The Fetch robot in MJX: `environment` holds the tasks; model, contacts, constraints, solver and physics what they stand on."""
