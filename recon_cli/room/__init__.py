"""Everything about walls and metres: the mesh, its planes, their measures and the plan."""
