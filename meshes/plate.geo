// Slender cantilever plate, 1 m x 0.1 m, in the xy plane, along x.
// Surface "plate"; curves "clamped" (x = 0) and "tip" (x = length).
SetFactory("Built-in");

length = 1.0;  // m, along x
width = 0.1;   // m, along y
size = 0.02;   // m, length of an element's edge

Point(1) = {0, 0, 0, size};
Point(2) = {length, 0, 0, size};
Point(3) = {length, width, 0, size};
Point(4) = {0, width, 0, size};

Line(1) = {1, 2};
Line(2) = {2, 3};
Line(3) = {3, 4};
Line(4) = {4, 1};

Curve Loop(1) = {1, 2, 3, 4};
Plane Surface(1) = {1};

Physical Surface("plate") = {1};
Physical Curve("clamped") = {4};
Physical Curve("tip") = {2};
