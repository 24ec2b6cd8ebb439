"""The search of a diagnosis: one incumbent, one pool of simulated models, one acceptance test.

Each step is one module. A round linearizes the motion around the incumbent (``physics``), proposes
models around it and ranks them along the motion (``neighbours``), simulates the best and fits a few
(``fit``), adds all to the pool (``model``), and accepts at most one (``search``, ``accept``). Where
none is accepted, other settings of the simulation, starts that effects propose and rivals of the
incumbent follow. The pool gives the confidences (``posterior``), and three rules decide which
effects carry a name (``report_rules``). ``structure`` searches whole recordings, or windows of
them.
"""
