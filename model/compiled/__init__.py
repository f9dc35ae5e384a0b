"""C for what numpy is slow at: many small matrices; all of it has a counterpart in numpy."""
