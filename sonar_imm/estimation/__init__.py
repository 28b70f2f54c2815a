"""Mathematics of multiple-model estimation: no sonar, no ROS, no clock, no global random state.

Two conventions hold in every module. A transition matrix is read ``P[i, j] = Pr(model j at k |
model i at k-1)``: rows sum to one. The cycle of a multiple-model filter is *mix, predict, update,
combine*.
"""
