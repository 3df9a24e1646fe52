// Quarter of a hemisphere with a hole of 18 degrees about its pole: a curved rest surface.
// Surface "shell"; curves "plane x" and "plane y" (in the symmetry planes x = 0 and y = 0), "rim", "hole";
// points "pulled" (on the x axis) and "pushed" (on the y axis). A vertex is in the middle of the rim.
SetFactory("Built-in");

radius = 10.0;              // m
hole = 18.0 * Pi / 180.0;   // angle at the centre, from the pole
size = 0.6;                 // m, length of an element's edge

high = radius * Cos(hole);
wide = radius * Sin(hole);

Point(1) = {0, 0, 0, size};
Point(2) = {0, 0, high, size};
Point(3) = {radius, 0, 0, size};
Point(4) = {0, radius, 0, size};
Point(5) = {wide, 0, high, size};
Point(6) = {0, wide, high, size};

Circle(1) = {3, 1, 4};
Circle(2) = {4, 1, 6};
Circle(3) = {6, 2, 5};
Circle(4) = {5, 1, 3};
Transfinite Curve {1} = 2 * Round(0.25 * Pi * radius / size) + 1;

Curve Loop(1) = {1, 2, 3, 4};
Surface(1) = {1} In Sphere {1};

Physical Surface("shell") = {1};
Physical Curve("rim") = {1};
Physical Curve("plane x") = {2};
Physical Curve("hole") = {3};
Physical Curve("plane y") = {4};
Physical Point("pulled") = {3};
Physical Point("pushed") = {4};
