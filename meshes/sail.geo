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

// the foot is an arc; the leech runs through points off the plane, with roach beyond the straight line
Point(4) = {0.25 * base, 0.75 * foot_camber, 0, size};
Point(5) = {0.50 * base, foot_camber, 0, size};
Point(6) = {0.75 * base, 0.75 * foot_camber, 0, size};
Point(7) = {0.78 * base, 0.70 * leech_twist, 0.27 * height, size};
Point(8) = {0.54 * base, leech_twist, 0.53 * height, size};
Point(9) = {0.27 * base, 0.70 * leech_twist, 0.77 * height, size};

Line(1) = {3, 1};
Spline(2) = {1, 4, 5, 6, 2};
Spline(3) = {2, 7, 8, 9, 3};

Curve Loop(1) = {1, 2, 3};
Surface(1) = {1};

Physical Surface("sail") = {1};
Physical Curve("luff") = {1};
Physical Curve("foot") = {2};
Physical Curve("leech") = {3};
Physical Point("tack") = {1};
Physical Point("clew") = {2};
Physical Point("head") = {3};
