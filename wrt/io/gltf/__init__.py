"""Reader of glTF 2.0: the document, its arrays, its materials, and the scene that wrt makes of them."""
