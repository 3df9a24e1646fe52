// Flag, 1.5 m x 1 m, in the xz plane; its normal is along y.
// Surface "flag"; curves "pole" (x = 0) and "fly" (the free vertical edge); point "tip" (free upper corner).
SetFactory("Built-in");

width = 1.5;   // m, along x
height = 1.0;  // m, along z
size = 0.04;   // m, length of an element's edge

Point(1) = {0, 0, 0, size};
Point(2) = {width, 0, 0, size};
Point(3) = {width, 0, height, size};
Point(4) = {0, 0, height, size};

Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};

Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};

Physical Surface("flag") = {1};
Physical Curve("pole") = {4};
Physical Curve("fly") = {2};
Physical Point("tip") = {3};
