"""What recordings are, settled before what the robot does.

A setpoint that moves between two logged commands, a velocity that the driver differenced, an effort
that was demanded and not measured: taken for something else, each becomes physics that the robot
does not have. One file answers one question, each with its confidence and its evidence in words.
Where the data cannot tell, the answer is None and nothing later may depend on it.
"""

from pytest_twin.diagnosis.recorded.command_between import Between
from pytest_twin.diagnosis.recorded.doubt import with_doubt
from pytest_twin.diagnosis.recorded.reconsidered import with_fewer_effects
from pytest_twin.diagnosis.recorded.settle import Settled, settle

__all__ = ["Between", "Settled", "settle", "with_doubt", "with_fewer_effects"]
