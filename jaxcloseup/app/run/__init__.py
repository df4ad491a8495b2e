"""How a scene is trained: the stages of a run, the arms of a sweep, and what both keep."""
