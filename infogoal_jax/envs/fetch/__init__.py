"""The Fetch robot. `environment` has the tasks, `physics` their simulation (over model, vectors, multibody, contacts,
constraints and solver), `image_goals` the tasks with image goals, `scene` their rendering."""
