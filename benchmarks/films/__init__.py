"""Films of hostile conditions whose truth is known: the shot, and what is done to it, one module a kind."""
