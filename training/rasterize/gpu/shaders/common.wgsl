// What all shaders share.

const LANES: u32 = 64;
const TILE: u32 = 16;

// A splat as an ellipse on the image: log2 alpha = log2_opacity - LOG2_E / 2 (d . conic d), d from the mean.
struct Row {
    mean: vec2f,  // in pixels
    half_size: vec2f,  // of the box around the ellipse on which alpha is ALPHA_MIN
    conic: vec3f,  // xx, xy and yy of the inverse covariance
    log2_opacity: f32,
    depth: f32,  // along the camera's z axis
    radius: f32,  // three standard deviations along the longest axis; 0: it is not drawn
}

// Whether the ellipse on which alpha is ALPHA_MIN meets a rectangle of pixel centres, from the first to the first and
// the span. The quadratic form is convex: outside the rectangle its minimum lies on one of the edges that face the
// mean.
fn touches(row: Row, first: vec2f, span: vec2f) -> bool {
    let low = first - row.mean;
    let high = low + span;
    let beside = low.x > 0.0 || high.x < 0.0;
    let above = low.y > 0.0 || high.y < 0.0;
    let a = row.conic.x;
    let b = row.conic.y;
    let c = row.conic.z;
    let reach = 2.0 * LN2 * (row.log2_opacity - LOG2_ALPHA_MIN);
    var meets = !beside && !above;
    if (beside) {
        let dx = select(high.x, low.x, low.x > 0.0);
        let dy = clamp(-b * dx / c, low.y, high.y);
        meets = meets || (a * dx + 2.0 * b * dy) * dx + c * dy * dy <= reach;
    }
    if (above) {
        let dy = select(high.y, low.y, low.y > 0.0);
        let dx = clamp(-b * dy / a, low.x, high.x);
        meets = meets || (a * dx + 2.0 * b * dy) * dx + c * dy * dy <= reach;
    }
    return meets;
}

// Work is done in pieces, and a piece begins with this workgroup.
@group(0) @binding(15) var<uniform> first_group: u32;

fn group_of(group: vec3u) -> u32 {
    return first_group + group.x;
}

// Columns of what blending's backward pass sums up for a splat, with sigma = -ln(alpha / opacity), g = d loss / d sigma
// and e = conic d: g, g e, g e et, and the sums over pixels of |g e|.
const G: u32 = 0;
const G_X: u32 = 1;
const G_Y: u32 = 2;
const G_XX: u32 = 3;
const G_XY: u32 = 4;
const G_YY: u32 = 5;
const ABS_X: u32 = 6;
const ABS_Y: u32 = 7;
const SUMS: u32 = 8;
// A pair has d loss / d colour besides.
const RED: u32 = 8;
const PAIR_SUMS: u32 = 11;
