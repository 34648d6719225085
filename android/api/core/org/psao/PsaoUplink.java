package org.psao;

import java.nio.charset.Charset;

/**
 * Writes what the client tells the server, as bytes for whatever transport there is, and counts
 * them: make one for each connection, and another one for datagrams.
 *
 * <p>Messages go to a buffer's position, which is then behind them. Threads: one at a time for each
 * object. No garbage unless a method says so.
 */
public final class PsaoUplink {
    /** The longest message that {@link #joints} writes, with 4096 joints, in bytes. */
    public static final int MAX_BYTES = 196628;
    /** The longest message of any other method, in bytes. */
    public static final int SMALL_BYTES = 384;

    private final Words counter = new Words(1);

    /** At the beginning of a connection. */
    public PsaoUplink() {}

    /**
     * Writes the first message of every connection: who you are, and how much you can hold. Begins
     * to count anew. Makes garbage.
     *
     * @param config the client's; the server refuses a scene that needs larger counts
     * @param token the one that the server was started with, at most 256 bytes in UTF-8
     * @param topologyHash of {@link PsaoClient#topologyHash}; 0 for a new client
     * @param out room for {@link #SMALL_BYTES}
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: the token is too long, or config is
     *     none. {@link PsaoResult#ERROR_OUTPUT_SIZE}: out has too little room
     */
    public void hello(PsaoConfig config, String token, long topologyHash, PsaoBuffer out) {
        byte[] bytes = token.getBytes(Charset.forName("UTF-8"));
        int from = out.bytes().position();
        written(out, from, Native.hello(
                counter.address, config.words(), bytes, topologyHash, out.address + from,
                room(out, from), this));
    }

    /**
     * Writes where you look from. Send it when it changes, at most once a frame; as a datagram if
     * the transport has them.
     *
     * @param fovYRad vertical field of view, above 0 and below pi
     * @param aspect width over height, above 0.001 and below 1000
     * @param heightPx rows of the picture, which decides how fine what is far away needs to be; 0:
     *     all as fine as near
     * @param positionXM world position, metres
     * @param positionYM world position, metres
     * @param positionZM world position, metres
     * @param forwardX view direction, not zero
     * @param forwardY view direction
     * @param forwardZ view direction
     * @param upX up, not zero and not along the view direction
     * @param upY up
     * @param upZ up
     * @param out room for {@link #SMALL_BYTES}
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: a value is outside its range, or not
     *     finite. {@link PsaoResult#ERROR_OUTPUT_SIZE}: out has too little room
     */
    public void camera(
            float fovYRad, float aspect, int heightPx,
            double positionXM, double positionYM, double positionZM,
            float forwardX, float forwardY, float forwardZ, float upX, float upY, float upZ,
            PsaoBuffer out) {
        int from = out.bytes().position();
        written(out, from, Native.camera(
                counter.address, fovYRad, aspect, heightPx, positionXM, positionYM, positionZM,
                forwardX, forwardY, forwardZ, upX, upY, upZ, out.address + from,
                room(out, from), this));
    }

    /**
     * Writes that you moved an instance: from then on this places it, and not the scene's
     * animation.
     *
     * @param instanceIndex which
     * @param worldFromLocal 12 numbers, three rows of four, metres, the translation in the fourth
     *     column
     * @param out room for {@link #SMALL_BYTES}
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: a number is not finite.
     *     {@link PsaoResult#ERROR_OUTPUT_SIZE}: out has too little room
     * @throws IllegalArgumentException if there are not 12 numbers
     */
    public void transform(int instanceIndex, double[] worldFromLocal, PsaoBuffer out) {
        if (worldFromLocal.length != 12) {
            throw new IllegalArgumentException(worldFromLocal.length + " numbers: 12 are needed");
        }
        int from = out.bytes().position();
        written(out, from, Native.transform(
                counter.address, instanceIndex, worldFromLocal, out.address + from,
                room(out, from), this));
    }

    /**
     * Writes how you posed a skinned instance.
     *
     * @param instanceIndex which
     * @param localFromRest 12 floats a joint from the buffer's first byte, three rows of four: what
     *     takes a vertex from rest space to local space
     * @param jointCount the skin's, at most 4096
     * @param out room for 20 bytes and 48 a joint, at most {@link #MAX_BYTES}
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: a number is not finite, the buffer's
     *     memory is not aligned to 4 bytes, or there are too many joints.
     *     {@link PsaoResult#ERROR_OUTPUT_SIZE}: out has too little room
     * @throws IllegalArgumentException if the count is below 0, the buffer too short, or out
     *     shares memory with it
     */
    public void joints(
            int instanceIndex, PsaoBuffer localFromRest, int jointCount, PsaoBuffer out) {
        if (jointCount < 0 || localFromRest.bytes().capacity() < 48L * jointCount) {
            throw new IllegalArgumentException(jointCount + " joints need 48 bytes each");
        }
        int from = out.bytes().position();
        PsaoBuffer.checkApart(
                localFromRest, 48L * jointCount, out.address + from, room(out, from));
        written(out, from, Native.joints(
                counter.address, instanceIndex, localFromRest.address, jointCount,
                out.address + from, room(out, from), this, localFromRest));
    }

    /**
     * Writes that you took an instance out of the scene, or put it back: what is out has no points
     * and occludes nothing. All are in at first. To swap an instance's mesh, have an instance for
     * each mesh, and put one of them in.
     *
     * @param instanceIndex which
     * @param present whether it is in the scene
     * @param out room for {@link #SMALL_BYTES}
     * @throws PsaoException {@link PsaoResult#ERROR_OUTPUT_SIZE}: out has too little room
     */
    public void presence(int instanceIndex, boolean present, PsaoBuffer out) {
        int from = out.bytes().position();
        written(out, from, Native.presence(
                counter.address, instanceIndex, present ? 1 : 0, out.address + from,
                room(out, from), this));
    }

    /**
     * Writes that a frame is in your mirror. Optional; a later one makes up for one that is lost.
     *
     * @param frameId of {@link PsaoFrame#frameId} or {@link PsaoStats#frameId}
     * @param out room for {@link #SMALL_BYTES}
     * @throws PsaoException {@link PsaoResult#ERROR_OUTPUT_SIZE}: out has too little room
     */
    public void ack(int frameId, PsaoBuffer out) {
        int from = out.bytes().position();
        written(out, from, Native.ack(
                counter.address, frameId, out.address + from, room(out, from), this));
    }

    /**
     * Writes that you need a snapshot, after {@link PsaoResult#RESYNC}.
     *
     * @param out room for {@link #SMALL_BYTES}
     * @throws PsaoException {@link PsaoResult#ERROR_OUTPUT_SIZE}: out has too little room
     */
    public void resync(PsaoBuffer out) {
        int from = out.bytes().position();
        written(out, from, Native.resync(
                counter.address, out.address + from, room(out, from), this));
    }

    /** Of a position that was read once, so that no thread can make it more than there is. */
    private static int room(PsaoBuffer out, int from) {
        return Math.max(0, out.bytes().limit() - from);
    }

    private static void written(PsaoBuffer out, int from, int bytes) {
        out.bytes().position(from + PsaoException.check(bytes));
    }
}
