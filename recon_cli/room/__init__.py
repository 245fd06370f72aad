"""What is known of walls and metres: the mesh, its planes, their measures and the plan."""
