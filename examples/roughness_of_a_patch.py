"""Surface roughness of a part of a cloud: `python roughness_of_a_patch.py cloud.ply X0 X1 Y0 Y1`, mm."""

import sys

import scope

cloud = scope.ScanCloud.load(sys.argv[1])
x0, x1, y0, y1 = (float(word) for word in sys.argv[2:6])
region = scope.Box(x=(x0, x1), y=(y0, y1))
try:
    found = scope.measure_roughness(cloud, region=region)
except scope.ScopeError as error:
    sys.exit(f"{error}")
print(found)
for name, parameter in found.areal.items():
    print(f"{name:5s} {parameter.in_words()}")
for note in found.notes:
    print(note)
