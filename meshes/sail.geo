// Triangular fore-and-aft sail with camber: a curved rest surface. Luff along z from tack to head,
// foot along x from tack to clew; seen from ahead the cloth bulges towards +y.
// Surface "sail"; curves "luff" (straight), "leech", "foot"; points "head", "tack", "clew".
SetFactory("Built-in");

height = 3.0;        // m, luff
base = 1.5;          // m, foot
foot_camber = 0.12;  // m, depth of the foot's arc
leech_twist = 0.10;  // m, how far the middle of the leech stands off the plane
size = 0.07;         // m, length of an element's edge

Point(1) = {0, 0, 0, size};       // tack
Point(2) = {base, 0, 0, size};    // clew
Point(3) = {0, 0, height, size};  // head

// control points of the curved edges; the leech also has roach, so it lies outside the straight line
Point(4) = {0.25 * base, 1.3 * foot_camber, 0, size};
Point(5) = {0.65 * base, 1.0 * foot_camber, 0, size};
Point(6) = {0.80 * base, 0.9 * leech_twist, 0.30 * height, size};
Point(7) = {0.45 * base, 1.2 * leech_twist, 0.66 * height, size};

Line(1) = {3, 1};
Bezier(2) = {1, 4, 5, 2};
Bezier(3) = {2, 6, 7, 3};

Curve Loop(1) = {1, 2, 3};
Surface(1) = {1};

Physical Surface("sail") = {1};
Physical Curve("luff") = {1};
Physical Curve("foot") = {2};
Physical Curve("leech") = {3};
Physical Point("tack") = {1};
Physical Point("clew") = {2};
Physical Point("head") = {3};
